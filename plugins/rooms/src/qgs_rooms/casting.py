"""Bands of images and depth maps of a room: bounds, rays and colours, one compiled call each."""

from __future__ import annotations

import numpy as np
from numba import njit

from qgs_rooms.materials import OPTIONS
from qgs_rooms.raycast import ray_basis, screen_bounds, trace
from qgs_rooms.shading import paint
from qgs_rooms.shapes import Room


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


def cast_colors(
    image: np.ndarray,
    rows: tuple[int, int],
    samples: int,
    room: Room,
    floor: np.ndarray,
    c2w: np.ndarray,
    intrinsics: np.ndarray,
) -> None:
    """Write rows [rows[0], rows[1]) of image (H, W, 3) uint8.

    Each pixel is the mean of samples x samples rays on a regular grid. floor: see
    `shadows.floor_shadows`. c2w: (4, 4) OpenCV. intrinsics: fx, fy, cx, cy in pixels.
    """
    packed = (room.shapes, room.textures, room.size, room.lights)
    _colors(image[slice(*rows)], rows[0], samples, packed, floor, c2w, intrinsics)


def cast_depths(
    depth: np.ndarray, rows: tuple[int, int], room: Room, c2w: np.ndarray, intrinsics: np.ndarray
) -> None:
    """Write rows [rows[0], rows[1]) of depth (H, W) float32: z of the ray through pixel centres."""
    top, bottom = rows
    depth[top:bottom] = _traced(
        bottom - top, depth.shape[1], top, 1, room.shapes, room.size, c2w, intrinsics
    )[0]
