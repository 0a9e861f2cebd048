"""Shadow maps: what each light sees, cast once for a scene by the kernels that cast its photos."""

import math

import numpy as np
from numba import njit

from qgs_worlds.caster import tables as s
from qgs_worlds.caster.kernels import INNER
from qgs_worlds.caster.raycast import trace
from qgs_worlds.caster.vectors import dot, longest, minus

# Pixels of the side of the sun's map, and of each of a lamp's six.
_SUN_SIDE = 224
_LAMP_SIDE = 72
# Metres to the sun: far enough for rays that are nearly parallel, near enough for float32.
_SUN = 300.0

# Rotations of a lamp's cameras, which look along +x, -x, +y, -y, +z, -z.
_FACES = np.zeros((6, 3, 3))
for _face in range(6):
    _axis = _face // 2
    _others = [axis for axis in range(3) if axis != _axis]
    _FACES[_face, [*_others, _axis], range(3)] = 1, 1, 1 - 2 * (_face % 2)


def shadow_maps(
    shapes: np.ndarray, heights: np.ndarray, lights: np.ndarray, middle: np.ndarray, radius: float
) -> tuple[np.ndarray, s.Shadows]:
    """Return the lights, with the number of their first map plus 1, and the maps.

    middle, radius: where the sun's shadows are seen; lamps throw theirs everywhere.
    """
    lights = lights.copy()
    maps = []
    # an array of each, as a scene may have no shadows
    depths = [np.zeros(0, np.float32)]
    codes = [np.zeros(0, np.float32)]
    begin = 0
    for light in lights:
        if not light["shadows"]:
            continue
        light["shadows"] = len(maps) + 1
        for c2w, side, focal in _views(light, middle, radius):
            lens = np.array([focal, focal, side / 2, side / 2])
            t, code, _ = trace(side, side, 0, 1, shapes, heights, c2w, lens)
            maps.append((begin, side, focal, c2w[:3]))
            depths.append(t.ravel())
            codes.append(code.ravel())
            begin += side * side
    return lights, s.Shadows(np.array(maps, s.MAP), np.concatenate(depths), np.concatenate(codes))


def _views(
    light: np.ndarray, middle: np.ndarray, radius: float
) -> list[tuple[np.ndarray, int, float]]:
    """Return c2w, side and focal length of the maps of a light."""
    place = light["place"]
    c2w = np.tile(np.eye(4), (6, 1, 1))
    if light["lamp"]:
        c2w[:, :3, :3] = _FACES
        c2w[:, :3, 3] = place
        return [(pose, _LAMP_SIDE, _LAMP_SIDE / 2) for pose in c2w]
    right = np.array([-place[1], place[0], 0.0]) / math.hypot(place[0], place[1])
    c2w[0, :3] = np.stack([right, np.cross(-place, right), -place, middle + _SUN * place], -1)
    return [(c2w[0], _SUN_SIDE, _SUN_SIDE / 2 * _SUN / radius)]


@njit(**INNER)
def _seen(shadows, k, own, p):
    """Return the share of a light that a point gets by map k; all of it outside of the map."""
    view = shadows.maps[k]
    side = view.side
    place = minus(p, view.c2w[:, 3])
    depth = dot(place, view.c2w[:, 2])
    scale = view.focal / depth
    a = scale * dot(place, view.c2w[:, 0]) + 0.5 * side - 0.5
    b = scale * dot(place, view.c2w[:, 1]) + 0.5 * side - 0.5
    # written so that NaN counts as outside
    if not (a > -1 and a < side and b > -1 and b < side):
        return 1.0
    a = min(max(a, 0.0), side - 1.001)
    b = min(max(b, 0.0), side - 1.001)
    i = int(b)
    j = int(a)
    a = a - j
    b = b - i
    # within a pixel of the map the depth of what shades itself varies
    bias = np.float32(depth - 0.01 - (1.5 / scale if own < 0 else 0.0))
    # percentage closer filtering over 2 x 2 pixels softens the edge
    light = 0.0
    for row in range(2):
        for column in range(2):
            at = view.begin + (i + row) * side + j + column
            if shadows.depths[at] > bias or (int(shadows.codes[at]) >> 3) == own:
                light += (b if row else 1 - b) * (a if column else 1 - a)
    return light


@njit(**INNER)
def lit(shadows, light, own, p):
    """Return the share of a light that reaches a point. own: its shape, if it shades itself not."""
    k = light.shadows - 1
    if light.lamp > 0:
        away = minus(p, light.place)
        axis = longest(away)
        k += 2 * axis + (0 if away[axis] > 0 else 1)
    return _seen(shadows, k, own, p)
