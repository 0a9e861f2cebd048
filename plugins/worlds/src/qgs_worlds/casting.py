"""Images and depth maps of a world, in bands of rows."""

import numpy as np

from qgs_worlds.raycast import trace
from qgs_worlds.rooms.bands import in_bands
from qgs_worlds.rows import World
from qgs_worlds.shading import paint


def cast_light(
    world: World,
    c2w: np.ndarray,
    intrinsics: np.ndarray,
    size: tuple[int, int],
    samples: int,
    depths: np.ndarray | None = None,
) -> np.ndarray:
    """Light (F, H, W, 3) float32, means of samples^2 rays. c2w: OpenCV. intrinsics: in pixels.

    depths: (F, samples H, samples W), to write z of the rays, inf in the sky.
    """
    light, packed = np.empty((len(c2w), *size, 3), np.float32), world.packed()

    def cast(frame: int, top: int, bottom: int) -> None:
        rows = (bottom - top, size[1], top, samples)
        t, code, rays = trace(*rows, world.shapes, world.heights, c2w[frame], intrinsics)
        if depths is not None:
            depths[frame, samples * top : samples * bottom] = t
        paint(light[frame, top:bottom], t, code, top, samples, packed, c2w[frame], rays)

    in_bands(cast, len(c2w), size[0])
    return light


def cast_depths(
    world: World, c2w: np.ndarray, intrinsics: np.ndarray, size: tuple[int, int]
) -> np.ndarray:
    """Depths (F, H, W) float32: z of the ray through each pixel's centre, 0 where it meets none."""
    depths = np.empty((len(c2w), *size), np.float32)

    def cast(frame: int, top: int, bottom: int) -> None:
        rows = (bottom - top, size[1], top, 1)
        t, _, _ = trace(*rows, world.shapes, world.heights, c2w[frame], intrinsics)
        depths[frame, top:bottom] = np.where(np.isfinite(t), t, 0)

    in_bands(cast, len(c2w), size[0])
    return depths
