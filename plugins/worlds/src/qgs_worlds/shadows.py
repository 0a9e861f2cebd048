"""Shadow maps: what each light sees, cast once for a scene by the kernels that cast its photos."""

import math

import numpy as np
from numba import njit

from qgs_worlds import rows as r
from qgs_worlds.kernels import BORROWING
from qgs_worlds.raycast import trace

_SUN_SIDE, _LAMP_SIDE = 224, 72  # pixels of the map of the sun, and of each of a lamp's six
_SUN = 300.0  # metres to the sun
# Fields of a map: where it begins, its side, focal length in pixels, c2w row by row.
_BEGIN, _SIDE, _FOCAL, _POSE, _FIELDS = 0, 1, 2, 3, 15

_FACES = [
    [[u, v, w] for u, v, w in zip(*axes, strict=True)]
    for axes in (
        ((0, 1, 0), (0, 0, 1), (1, 0, 0)),
        ((0, 1, 0), (0, 0, 1), (-1, 0, 0)),
        ((1, 0, 0), (0, 0, 1), (0, 1, 0)),
        ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
        ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
        ((1, 0, 0), (0, 1, 0), (0, 0, -1)),
    )
]


def shadow_maps(
    shapes: np.ndarray, heights: np.ndarray, lights: np.ndarray, middle: np.ndarray, radius: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The lights, with the number of their first map plus 1; maps (M, _FIELDS); depths and codes.

    Depths and codes of all maps lie behind each other. middle, radius: where the sun's shadows are
    seen; lamps throw theirs everywhere.
    """
    nothing = np.zeros(0, np.float32)
    lights, maps, depths, codes = lights.copy(), [], [nothing], [nothing]
    begin = 0
    for light in lights:
        if light[r.SHADOWS] == 0:
            continue
        light[r.SHADOWS] = len(maps) + 1
        for c2w, side, focal in _views(light, middle, radius):
            lens = np.array([focal, focal, side / 2, side / 2])
            t, code, _ = trace(side, side, 0, 1, shapes, heights, c2w, lens)
            maps.append([begin, side, focal, *c2w[:3].ravel()])
            depths.append(t.ravel())
            codes.append(code.ravel())
            begin += side * side
    table = np.array(maps).reshape(-1, _FIELDS)
    return lights, table, np.concatenate(depths), np.concatenate(codes)


def _views(
    light: np.ndarray, middle: np.ndarray, radius: float
) -> list[tuple[np.ndarray, int, float]]:
    """c2w, side and focal length of the maps of a light."""
    way = light[r.PLACE : r.PLACE + 3]
    c2w = np.tile(np.eye(4), (6, 1, 1))
    if light[r.LAMP]:
        c2w[:, :3, :3], c2w[:, :3, 3] = _FACES, way
        return [(pose, _LAMP_SIDE, _LAMP_SIDE / 2) for pose in c2w]
    right = np.array([-way[1], way[0], 0.0]) / math.hypot(way[0], way[1])
    c2w[0, :3] = np.stack([right, np.cross(-way, right), -way, middle + _SUN * way], -1)
    return [(c2w[0], _SUN_SIDE, _SUN_SIDE / 2 * _SUN / radius)]


@njit(**BORROWING)
def _seen(maps, depths, codes, k, own, x, y, z):
    """The share of a light that a point gets by map k; all of it outside of the map."""
    x, y, z = x - maps[k, _POSE + 3], y - maps[k, _POSE + 7], z - maps[k, _POSE + 11]
    p = _POSE
    depth = x * maps[k, p + 2] + y * maps[k, p + 6] + z * maps[k, p + 10]
    scale, side = maps[k, _FOCAL] / depth, int(maps[k, _SIDE])
    a = scale * (x * maps[k, p] + y * maps[k, p + 4] + z * maps[k, p + 8]) + 0.5 * side - 0.5
    b = scale * (x * maps[k, p + 1] + y * maps[k, p + 5] + z * maps[k, p + 9]) + 0.5 * side - 0.5
    if not (a > -1 and a < side and b > -1 and b < side):
        return 1.0
    a, b = min(max(a, 0.0), side - 1.001), min(max(b, 0.0), side - 1.001)
    i, j = int(b), int(a)
    a, b = a - j, b - i
    # within a pixel of the map the depth of what shades itself varies
    bias = np.float32(depth - 0.01 - (1.5 / scale if own < 0 else 0.0))
    place = int(maps[k, _BEGIN]) + i * side + j
    light = 0.0
    for row in range(2):
        for column in range(2):
            at = place + row * side + column
            if depths[at] > bias or (int(codes[at]) >> 3) == own:
                light += (b if row else 1 - b) * (a if column else 1 - a)
    return light


@njit(**BORROWING)
def lit(shadows, lights, light, own, x, y, z):
    """The share of a light that reaches a point. own: its shape, if it throws none on itself."""
    maps, depths, codes = shadows
    k = int(lights[light, r.SHADOWS]) - 1
    if lights[light, r.LAMP] > 0:
        dx, dy, dz = (
            x - lights[light, r.PLACE],
            y - lights[light, r.PLACE + 1],
            z - lights[light, r.PLACE + 2],
        )
        if abs(dx) >= abs(dy) and abs(dx) >= abs(dz):
            k += 0 if dx > 0 else 1
        elif abs(dy) >= abs(dz):
            k += 2 if dy > 0 else 3
        else:
            k += 4 if dz > 0 else 5
    return _seen(maps, depths, codes, k, own, x, y, z)
