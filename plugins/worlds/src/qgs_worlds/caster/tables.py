"""NumPy record types that describe shapes, textures, lights and air to the ray caster.

The world frame is in metres, with z up. A shape is a primitive (`body`), from which a second,
convex primitive (`cut`) may be removed.
"""

from typing import NamedTuple

import numpy as np

# Kinds that fit the cube [-1, 1]^3 of their own frame; a capsule is longer.
ELLIPSOID, BOX, FRUSTUM, CAPSULE, TORUS, HEIGHT = range(6)
# Upright kinds in metres: shapes of furnished rooms, and a room from inside.
BLOCK, BALL, CYLINDER, INTERIOR = range(6, 10)
# kind of the second primitive of a shape that has none
NOTHING = -1

# kinds of noise
VALUE, GRADIENT, CELLS = range(3)
NO_PATTERN, STRIPES, CHECKER, TILES, DOTS, GLYPHS, RINGS = range(7)

PRIMITIVE = np.dtype(
    [
        ("kind", "i4"),
        # a frustum's upper radius, half a capsule's length, both by the radius, the thickness of a
        # torus by its outer radius, or the index of a height map
        ("extra", "f4"),
        ("axes", "f4", (3, 3)),  # from world to local
        ("center", "f4", 3),
        ("unit", "f4", 3),  # metres per unit of the local frame
        ("extent", "f4", 3),  # half sizes in the local frame
    ]
)
SHAPE = np.dtype(
    [
        ("body", PRIMITIVE),
        ("cut", PRIMITIVE),
        ("radius", "f4"),  # of the bounding sphere
        ("texture", "i4"),  # first one of `faces`
        ("faces", "i4"),
        ("cut_texture", "i4"),
        ("scale", "f4"),  # metres per unit of a texture
    ]
)
# Periods are in units of the texture. colors: linear RGB, three of the ramp, one of the pattern.
TEXTURE = np.dtype(
    [
        *[(name, "i8") for name in ("seed", "basis", "octaves", "pattern")],
        *[
            (name, "f8")
            for name in (
                "period", "gain", "contrast", "warp", "stretch", "pattern_period", "aspect",
                "width", "strength", "tone", "specular", "shine", "emission",
            )
        ],
        ("colors", "f8", (4, 3)),
    ]
)  # fmt: skip
# lamp: 1, or 0 for the sun. place: a lamp's position, or the direction to the sun. shadows: 0 for a
# light that throws none, or the number of its first map plus 1.
LIGHT = np.dtype([("lamp", "f8"), ("place", "f8", 3), ("color", "f8", 3), ("shadows", "i8")])
# Light from above and from below; the sky overhead and at the horizon; fog per metre; clouds;
# strength of the ambient occlusion; seed of the clouds; reach of the ambient occlusion.
AIR = np.dtype(
    [
        *[(name, "f8", 3) for name in ("above", "below", "zenith", "horizon")],
        *[(name, "f8") for name in ("fog", "clouds", "occlusion")],
        ("seed", "i8"),
        ("reach", "f8"),
    ]
)
# A map of what a light sees: where its pixels begin, its side and focal length in pixels, its pose.
MAP = np.dtype([("begin", "i8"), ("side", "i8"), ("focal", "f8"), ("c2w", "f8", (3, 4))])


class Shadows(NamedTuple):
    """Shadow maps of all lights.

    maps: table of MAP, one row for each map. depths, codes: depth and face code of every pixel; the
    pixels of the maps follow one another.
    """

    maps: np.ndarray
    depths: np.ndarray
    codes: np.ndarray


class World(NamedTuple):
    """Abstract scene for the ray caster: tables of SHAPE, TEXTURE and LIGHT, and one row of AIR.

    heights: K height maps (K, G, G) float32 in [-1, 1]. shadows: shadow maps of the lights.
    """

    shapes: np.ndarray
    heights: np.ndarray
    textures: np.ndarray
    lights: np.ndarray
    air: np.ndarray
    shadows: Shadows


Size = tuple[float, float, float]
"""Size of a room along x, y and z, in metres."""


class Room(NamedTuple):
    """Furnished room for the ray caster.

    shapes: table of SHAPE; row 0 is the room itself. heights: height maps (K, G, G), which rooms do
    not use. textures: table of TEXTURE. size: x, y, z extent in metres. lights: table of LIGHT.
    floor: factors (C, C) by which shadows reduce the light on the floor, indexed by x, then y.
    """

    shapes: np.ndarray
    heights: np.ndarray
    textures: np.ndarray
    size: Size
    lights: np.ndarray
    floor: np.ndarray
