"""Pieces of furniture, each a list of shapes about the origin whose back is towards +y."""

from collections.abc import Callable
from random import Random

import numpy as np

from qgs_worlds.rooms.materials import Materials
from qgs_worlds.rooms.shapes import Shape, box, cylinder, sphere

Piece = list[Shape]


def _legs(w: float, d: float, h: float, thick: float, texture: int) -> Piece:
    x = w / 2 - thick
    y = d / 2 - thick
    return [box(a * x, b * y, 0, (thick, thick, h), texture) for a in (-1, 1) for b in (-1, 1)]


def _on_top(rng: Random, material: Materials, x: float, y: float, z: float) -> Piece:
    """Something small that stands at (x, y, z)."""
    pick = rng.randrange(5)
    if pick == 0:
        r = rng.uniform(0.05, 0.09)
        h = rng.uniform(0.15, 0.3)
        return [
            cylinder(x, y, z, r, h, material("fabric")),
            sphere(x, y, z + h - 0.3 * r, 1.5 * r, material("paint")),
        ]
    if pick == 1:
        return [sphere(x, y, z, rng.uniform(0.06, 0.12), material("fabric"))]
    if pick == 2:
        metal = material("metal")
        return [
            cylinder(x, y, z, 0.07, 0.02, metal),
            cylinder(x, y, z, 0.015, 0.3, metal),
            cylinder(x, y, z + 0.25, 0.11, 0.16, material("glow")),
        ]
    if pick == 3:
        return [
            box(x, y, z + 0.035 * i, (0.22 - 0.03 * i, 0.16, 0.034), material("paint")) for i in range(3)
        ]
    return [box(x, y, z, (0.16, 0.16, rng.uniform(0.1, 0.25)), material("fabric"))]


def table(rng: Random, material: Materials) -> Piece:
    """A dining table with things on it and chairs around."""
    w = rng.uniform(1.0, 1.6)
    d = rng.uniform(0.7, 0.95)
    h = rng.uniform(0.7, 0.76)
    wood = material("timber")
    piece = [box(0, 0, h - 0.04, (w, d, 0.04), wood), *_legs(w, d, h - 0.04, 0.06, wood)]
    for x in [rng.uniform(-0.38, 0.38) for _ in range(rng.randrange(1, 4))]:
        piece += _on_top(rng, material, x * w, rng.uniform(-0.3, 0.3) * d, h)
    # chairs around one table are alike
    seat = material("fabric")
    frame = material("timber")
    for sign, turn in ((1, 0.0), (-1, np.pi)):
        for x in (-w / 4, w / 4):
            if rng.random() < 0.75:
                away = sign * (d / 2 + rng.uniform(0.0, 0.2))
                piece += [part.moved(sign * x, away, turn) for part in _chair(seat, frame)]
    return piece


def _chair(seat: int, frame: int) -> Piece:
    return [
        box(0, 0, 0.42, (0.42, 0.42, 0.05), seat),
        *_legs(0.42, 0.42, 0.42, 0.04, frame),
        box(0, 0.19, 0.62, (0.42, 0.03, 0.3), seat),
        *[box(x, 0.19, 0.47, (0.03, 0.03, 0.4), frame) for x in (-0.18, 0.18)],
    ]


def chair(rng: Random, material: Materials) -> Piece:
    """A single chair."""
    return _chair(material("fabric"), material("timber"))


def round_table(rng: Random, material: Materials) -> Piece:
    """A round table on one foot."""
    r = rng.uniform(0.35, 0.55)
    h = rng.uniform(0.45, 0.72)
    wood = material("timber")
    metal = material("metal")
    piece = [
        cylinder(0, 0, 0, 0.6 * r, 0.03, metal),
        cylinder(0, 0, 0.03, 0.04, h - 0.06, metal),
        cylinder(0, 0, h - 0.03, r, 0.03, wood),
    ]
    return piece + _on_top(rng, material, 0.3 * r, 0.2 * r, h) + _on_top(rng, material, -0.4 * r, 0, h)


def sofa(rng: Random, material: Materials) -> Piece:
    """A sofa with arms and cushions."""
    w = rng.uniform(1.4, 2.1)
    d = 0.85
    cloth = material("fabric")
    feet = material("metal")
    piece = [
        box(0, 0, 0.1, (w, d, 0.32), cloth),
        box(0, d / 2 - 0.1, 0.42, (w, 0.2, 0.42), cloth),
        *[box(x, 0, 0.42, (0.18, d, 0.18), cloth) for x in (0.09 - w / 2, w / 2 - 0.09)],
        *_legs(w, d, 0.1, 0.06, feet),
    ]
    for x in [rng.uniform(-0.32, 0.32) for _ in range(rng.randrange(1, 4))]:
        cushion = box(0, 0, 0.43, (0.4, 0.13, 0.36), material("fabric"))
        piece.append(cushion.moved(x * w, 0.12, rng.gauss(0, 0.15)))
    return piece


def shelf(rng: Random, material: Materials) -> Piece:
    """A bookcase, some boards full of books, others with ornaments."""
    w = rng.uniform(0.8, 1.5)
    d = 0.32
    levels = rng.randrange(3, 6)
    step = 0.38
    h = levels * step
    wood = material("timber")
    piece = [
        *[box(x, 0, 0, (0.04, d, h), wood) for x in (-w / 2, w / 2)],
        box(0, d / 2 - 0.01, 0, (w, 0.02, h), wood),
    ]
    piece += [box(0, 0, min(i * step, h - 0.03), (w, d, 0.03), wood) for i in range(levels + 1)]
    for i in range(levels):
        z = i * step + 0.03
        left = -w / 2 + 0.04
        while left < w / 2 - 0.3:
            run = rng.uniform(0.18, 0.45)
            if rng.random() < 0.72:
                high = rng.uniform(0.2, 0.3)
                piece.append(box(left + run / 2, 0.02, z, (run - 0.02, 0.22, high), material("books")))
            else:
                piece.append(sphere(left + run / 2, 0, z, rng.uniform(0.06, 0.09), material("paint")))
            left += run
    return piece


def sideboard(rng: Random, material: Materials) -> Piece:
    """A low cupboard with doors and things on it."""
    w = rng.uniform(1.0, 1.7)
    d = 0.42
    h = rng.uniform(0.6, 0.85)
    front = material("paint") if rng.random() < 0.4 else material("timber")
    knob = material("metal")
    piece = [box(0, 0, 0.08, (w, d, h - 0.08), material("timber")), box(0, 0, 0, (w - 0.1, d, 0.08), knob)]
    doors = rng.randrange(2, 4)
    for i in range(doors):
        x = (i + 0.5) * w / doors - w / 2
        piece.append(box(x, -d / 2, 0.12, (w / doors - 0.04, 0.03, h - 0.18), front))
        piece.append(sphere(x + 0.3 * w / doors, -d / 2 - 0.03, h / 2, 0.025, knob))
    # places apart, so that nothing stands in anything
    for x in (-0.32, 0.05, 0.33):
        if rng.random() < 0.75:
            piece += _on_top(rng, material, x * w, 0, h)
    return piece


def wardrobe(rng: Random, material: Materials) -> Piece:
    """A tall cupboard."""
    w = rng.uniform(0.9, 1.4)
    d = 0.55
    h = rng.uniform(1.7, 2.1)
    front = material("timber")
    knob = material("metal")
    piece = [box(0, 0, 0, (w, d, h), material("timber"))]
    for side in (-1, 1):
        piece.append(box(side * w / 4, -d / 2, 0.06, (w / 2 - 0.03, 0.03, h - 0.12), front))
        piece.append(box(side * 0.06, -d / 2 - 0.03, 0.9, (0.02, 0.03, 0.25), knob))
    return piece


def floor_lamp(rng: Random, material: Materials) -> Piece:
    """A lamp on a pole."""
    metal = material("metal")
    h = rng.uniform(1.2, 1.5)
    return [
        cylinder(0, 0, 0, 0.16, 0.03, metal),
        cylinder(0, 0, 0.03, 0.018, h, metal),
        cylinder(0, 0, h, rng.uniform(0.16, 0.24), 0.3, material("glow")),
    ]


def plant(rng: Random, material: Materials) -> Piece:
    """A pot with a few round clumps of leaves."""
    leaves = material("leaves")
    piece = [
        cylinder(0, 0, 0, 0.17, 0.32, material("paint")),
        cylinder(0, 0, 0.32, 0.025, 0.35, material("timber")),
    ]
    for _ in range(rng.randrange(3, 6)):
        x, y = [rng.uniform(-0.16, 0.16) for _ in range(2)]
        piece.append(sphere(x, y, rng.uniform(0.5, 0.85), rng.uniform(0.12, 0.2), leaves))
    return piece


def balls(rng: Random, material: Materials) -> Piece:
    """Balls left on the floor."""
    between = rng.uniform
    return [
        sphere(between(-0.35, 0.35), between(-0.35, 0.35), 0, between(0.08, 0.2), material("fabric"))
        for _ in range(rng.randrange(1, 4))
    ]


def crates(rng: Random, material: Materials) -> Piece:
    """A stack of two boxes."""
    a = rng.uniform(0.35, 0.5)
    b = rng.uniform(0.22, 0.33)
    upper = box(0, 0, a, (b, b, b), material("fabric")).moved(0.03, 0.02, rng.uniform(0, 1.5))
    return [box(0, 0, 0, (a, a, a), material("fabric")), upper]


Maker = Callable[[Random, Materials], Piece]
AGAINST_WALLS: tuple[Maker, ...] = (
    shelf, sofa, sideboard, wardrobe, shelf, sideboard, plant, floor_lamp, crates,
)  # fmt: skip
CENTRAL: tuple[Maker, ...] = (table, table, round_table)
LOOSE: tuple[Maker, ...] = (balls, chair, crates, plant, floor_lamp, round_table)
