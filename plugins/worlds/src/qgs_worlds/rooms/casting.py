"""Images and depth maps of a room, in bands of rows, each one compiled call."""

import numpy as np
from numba import njit

from qgs_worlds.rooms.bands import in_bands
from qgs_worlds.rooms.raycast import ray_basis, screen_bounds, trace
from qgs_worlds.rooms.shading import paint
from qgs_worlds.rooms.shapes import Room
from qgs_worlds.rooms.textures import OPTIONS


def cast_images(
    room: Room,
    floor: np.ndarray,
    c2w: np.ndarray,
    intrinsics: np.ndarray,
    size: tuple[int, int],
    samples: int,
) -> np.ndarray:
    """Images (F, H, W, 3) uint8, means of samples^2 rays. c2w: OpenCV. intrinsics: in pixels."""
    images = np.empty((len(c2w), *size, 3), np.uint8)
    packed = (room.shapes, room.textures, room.size, room.lights)

    def cast(frame: int, top: int, bottom: int) -> None:
        band = images[frame][top:bottom]
        _colors(band, top, samples, packed, floor, c2w[frame], intrinsics)

    in_bands(cast, len(c2w), size[0])
    return images


def cast_depths(
    room: Room, c2w: np.ndarray, intrinsics: np.ndarray, size: tuple[int, int]
) -> np.ndarray:
    """Depths (F, H, W) float32: z of the ray through each pixel's centre; see `cast_images`."""
    depths = np.empty((len(c2w), *size), np.float32)

    def cast(frame: int, top: int, bottom: int) -> None:
        view = (room.shapes, room.size, c2w[frame], intrinsics)
        depths[frame, top:bottom] = _traced(bottom - top, size[1], top, 1, *view)[0]

    in_bands(cast, len(c2w), size[0])
    return depths


@njit(**OPTIONS)
def _traced(rows, columns, top, samples, shapes, size, c2w, intrinsics):
    t = np.empty((rows * samples, columns * samples), np.float32)
    code = np.empty((rows * samples, columns * samples), np.float32)
    rays = ray_basis(c2w, intrinsics)
    trace(t, code, top, samples, shapes, size, screen_bounds(shapes, c2w, intrinsics), c2w, rays)
    return t, code, rays


@njit(**OPTIONS)
def _colors(image, top, samples, room, floor, c2w, intrinsics):
    shapes, _, size, _ = room
    rows, columns, _ = image.shape
    t, code, rays = _traced(rows, columns, top, samples, shapes, size, c2w, intrinsics)
    paint(image, t, code, top, samples, room, floor, c2w, rays)
