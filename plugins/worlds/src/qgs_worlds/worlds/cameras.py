"""Random cameras: walks, orbits, turns on the spot, and cameras scattered around a point."""

import math
from typing import NamedTuple

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike

from qgs_worlds.caster.intervals import clearances
from qgs_worlds.caster.lens import lens, look_along
from qgs_worlds.caster.raycast import trace
from qgs_worlds.worlds.places import Place

# least distance in metres from a camera to the box around any shape, before scaling
CLEARANCE = 0.2
# across the longer side of an image, degrees: from a long lens to a wide one
FOV = (18.0, 90.0)
# least field of view in degrees at which cameras of a walk may only look ahead
AHEAD_FOV = 60.0
# length of a path relative to the distance of its target
BASELINE = (0.04, 1.3)
PLAIN_FOV = (60.0, 75.0)
PLAIN_TRAVEL = (0.65, 1.2)
_TRIES = 12
# size in pixels of the depth maps that rate views
_PROBE = (6, 6)


class Rig(NamedTuple):
    """The F cameras of a scene.

    c2w: poses (F, 4, 4) with OpenCV axes. fov: field of view along the longer side of an image, in
    degrees. distance: metres from the cameras to the point that they look at. motion: name of the
    camera motion, such as "walk".
    """

    c2w: np.ndarray
    fov: float
    distance: float
    motion: str

    def lens(self, size: tuple[int, int]) -> np.ndarray:
        """Return intrinsics fx, fy, cx, cy in pixels for images of `size` (H, W)."""
        return lens(self.fov, max(size), size)

    def sight(self, place: Place) -> tuple[np.ndarray, float]:
        """Return centre and radius, in metres, of a ball around most of what the cameras see.

        Indoors it is a ball around the room.
        """
        if place.kind == "indoors":
            half = 0.5 * place.top
            return np.array([0.0, 0.0, half]), math.hypot(*place.high[:2], half) + 0.5
        middle = (self.c2w[:, :3, 3] + self.distance * self.c2w[:, :3, 2]).mean(0)
        return middle, 1.3 * self.distance + 1


class Path(NamedTuple):
    """Parameters of a camera path through or around the point `base`, with views of `target`.

    length: length of the path in metres. s: position of each camera on the path, from -0.5 (start)
    to 0.5 (end). fov: field of view along the longer side of an image, in degrees.
    """

    base: np.ndarray
    target: np.ndarray
    length: float
    s: np.ndarray
    fov: float


Motion = tuple[np.ndarray, np.ndarray]
"""Camera centres (F, 3), and the points (F, 3), or one point, that the cameras look at."""


def draw_cameras(
    rng: Generator, place: Place, world: tuple[np.ndarray, np.ndarray], count: int, varied: bool
) -> Rig:
    """Return `count` random cameras in `place` with useful views.

    world: table of SHAPE, and height maps. varied: False gives only level walks, True all motions.
    The cameras are the best of a few random sets and keep the distance CLEARANCE from fixed shapes.
    The caller must remove movable shapes that are nearer.
    """
    fixed = world[0][: place.fixed]
    best = None
    least = math.inf
    # paths shrink from try to try, because short ones fit anywhere
    for attempt in range(_TRIES):
        rig = _draw(rng, place, count, varied, 0.7**attempt)
        eyes = rig.c2w[:, :3, 3]
        inside = (eyes >= place.low).all() and (eyes <= place.high).all()
        clear = inside and clearances(fixed, eyes).min() > CLEARANCE
        fault = _view_fault(rig, world) if clear else 100.0
        if fault < least:
            best = rig
            least = fault
        # good enough: each try casts all views
        if least <= 0.3:
            break
    assert best is not None
    if least < 100:
        return best
    # any point is better than one inside a wall: the one of 64 that is farthest from fixed shapes
    points = rng.uniform(place.low, place.high, (64, 3))
    base = points[clearances(fixed, points).min(1).argmax()]
    eyes = base + 0.01 * rng.uniform(-1, 1, (count, 3))
    c2w = _look_at(eyes, np.array(place.targets[0]))
    return best._replace(c2w=c2w, motion="still")


def _view_fault(rig: Rig, world: tuple[np.ndarray, np.ndarray]) -> float:
    """Return a penalty, 0 or more, for views with much sky or with surfaces close to the camera."""
    intrinsics = rig.lens(_PROBE)
    near = clearances(world[0], rig.c2w[:, :3, 3]).min()
    views = [trace(*_PROBE, 0, 1, *world, c2w, intrinsics)[0].ravel() for c2w in rig.c2w]
    t = np.stack(views)
    close = float((t < max(0.25, 0.25 * rig.distance)).mean(1).max())
    sky = float((t == np.inf).mean(1).max())
    return max(close, sky - 0.3, 2.0 if near < CLEARANCE else 0.0)


def _draw(rng: Generator, place: Place, count: int, varied: bool, shrink: float) -> Rig:
    """Return random cameras that have not been tested for collisions.

    shrink: factor from 0 to 1 by which the camera path is made shorter.
    """
    target = np.array(place.targets[rng.integers(len(place.targets))])
    base, distance = _stand(rng, place, target, varied)
    s = np.linspace(-0.5, 0.5, count)
    if not varied:
        across = np.cross(target - base, (0.0, 0.0, 1.0))
        step = across / np.linalg.norm(across) * max(rng.uniform(*PLAIN_TRAVEL) * shrink, 0.05)
        target = np.array([*target[:2], base[2] - rng.uniform(0.1, 0.4)])
        c2w = _look_at(base + s[:, None] * step, target + 0.1 * s[:, None] * step)
        return Rig(c2w, rng.uniform(*PLAIN_FOV), distance, "walk")
    low, high = np.log(BASELINE)
    length = distance * math.exp(rng.uniform(low, high)) * shrink
    motion = [*_MOTIONS][rng.choice(4, p=(0.35, 0.3, 0.1, 0.25))]
    fov = rng.uniform(*FOV)
    eyes, targets = _MOTIONS[motion](rng, Path(base, target, length, s, fov))
    # hands are not steady
    eyes = eyes + 0.03 * length * rng.normal(size=eyes.shape)
    targets = targets + 0.05 * distance * rng.normal(size=3)
    targets = targets + 0.02 * distance * rng.normal(size=eyes.shape)
    roll = np.clip(rng.normal(0, 5) + rng.normal(0, 1, count), -15, 15)
    c2w = _look_at(eyes, targets, np.radians(roll))
    # walks and orbits go both ways
    order = -1 if rng.random() < 0.5 else 1
    # a copy, because torch takes no array with a negative stride
    return Rig(np.ascontiguousarray(c2w[::order]), fov, distance, motion)


def _stand(
    rng: Generator, place: Place, target: np.ndarray, varied: bool
) -> tuple[np.ndarray, float]:
    """Return a random camera centre with a view of the target, and its distance to the target."""
    low, high = np.log(place.distance)
    for _ in range(20):
        distance = math.exp(rng.uniform(low, high))
        angle = rng.uniform(0, math.tau)
        height = rng.uniform(*place.eyes)
        if varied and rng.random() < 0.3:
            height = rng.uniform(
                place.low[2], max(min(place.high[2], target[2] + 0.8 * distance), place.low[2])
            )
        # not steeper than 60 degrees
        flat = math.sqrt(max(distance**2 - (height - target[2]) ** 2, (0.5 * distance) ** 2))
        base = np.array(
            [target[0] + flat * math.cos(angle), target[1] + flat * math.sin(angle), height]
        )
        if (base > place.low).all() and (base < place.high).all():
            break
    base = np.clip(base, place.low, place.high)
    return base, max(float(np.linalg.norm(base - target)), 0.3)


def _walk(rng: Generator, path: Path) -> Motion:
    """Return camera centres on a bent line, and the points that the cameras look at.

    If the field of view is wide, cameras may look ahead, not only at the target.
    """
    base, target, length, s, fov = path
    # people move more along the ground than up
    way = rng.normal(size=3) * (1, 1, 0.3)
    way /= np.linalg.norm(way)
    bend = rng.normal(size=3) * (0.3, 0.3, 0.1)
    eyes = base + length * (s[:, None] * way + (s**2)[:, None] * bend)
    ahead = rng.uniform(0, min(fov / AHEAD_FOV, 1))
    return eyes, target + ahead * (eyes - base)


def _orbit(rng: Generator, path: Path) -> Motion:
    """Return camera centres around the target, which all cameras look at.

    Height and distance change a little along the path.
    """
    base, target, length, s, _ = path
    offset = base - target
    flat = max(math.hypot(*offset[:2]), 0.2)
    # less than half of a circle; otherwise views share too little
    angles = s * min(length / flat, 2.4)
    nearer = 1 + 0.2 * rng.normal() * s
    rise = 0.2 * length * rng.normal() * s
    way = _turned(offset, angles)
    way[:, :2] *= nearer[:, None]
    way[:, 2] += rise
    return target + way, target


def _round(rng: Generator, path: Path) -> Motion:
    """Return camera centres near one point, and the points that the cameras look at.

    The viewing direction turns from camera to camera, by so little that views overlap.
    """
    base, target, length, s, fov = path
    angles = s * math.radians(fov) * rng.uniform(0.3, 1.2)
    way = _turned(target - base, angles)
    eyes = base + 0.3 * length * rng.normal(size=3) * s[:, None]
    return eyes, eyes + way


def _gather(rng: Generator, path: Path) -> Motion:
    """Return random camera centres around one point; all cameras look at the target."""
    base, target, length, s, _ = path
    offsets = rng.normal(size=(len(s), 3)) * (1, 1, 0.5)
    # the square root spreads them nearly evenly over the disc
    offsets *= rng.random((len(s), 1)) ** 0.5 / np.linalg.norm(offsets, axis=1, keepdims=True)
    return base + 0.5 * length * offsets, target


_MOTIONS = {"walk": _walk, "orbit": _orbit, "round": _round, "gather": _gather}


def _turned(way: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Return the vectors (F, 3) that are `way`, turned about z by F angles (F,) in radians."""
    x, y, z = way
    cos = np.cos(angles)
    sin = np.sin(angles)
    return np.stack([cos * x - sin * y, sin * x + cos * y, np.full_like(angles, z)], 1)


def _look_at(eyes: np.ndarray, targets: np.ndarray, roll: ArrayLike = 0.0) -> np.ndarray:
    forward = targets - eyes
    flat = np.linalg.norm(forward[:, :2], axis=1)
    # never straight up or down, where the right direction is undefined
    forward[:, 2] = np.clip(forward[:, 2], -4 * flat, 4 * flat)
    forward[flat < 1e-6] = (1.0, 0.0, 0.0)
    return look_along(eyes, forward, roll)
