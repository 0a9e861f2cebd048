"""Images and depth maps of scenes, in bands of rows, which threads share."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch

from qgs_worlds.caster.raycast import trace
from qgs_worlds.caster.tables import Room, World

# Rows of an image that one thread casts at a time: small enough to share, and to stay in its cache.
_BAND = 64

Size = tuple[int, int]
"""Height and width in pixels."""


def cast(
    scene: World | Room,
    paint: Callable[..., None],
    images: np.ndarray,
    c2w: np.ndarray,
    intrinsics: np.ndarray,
    samples: int,
    depths: np.ndarray | None = None,
) -> None:
    """Write images (F, H, W, 3), means of samples^2 rays. c2w: OpenCV. intrinsics: in pixels.

    paint: kernel that colours a band of an image. depths: (F, samples H, samples W), to write z of
    the rays, inf in the sky.
    """

    def band(frame: int, top: int, bottom: int) -> None:
        rows = (bottom - top, images.shape[2], top, samples)
        t, code, rays = trace(*rows, scene.shapes, scene.heights, c2w[frame], intrinsics)
        if depths is not None:
            depths[frame, samples * top : samples * bottom] = t
        paint(images[frame, top:bottom], t, code, top, samples, scene, c2w[frame], rays)

    _in_bands(band, len(c2w), images.shape[1])


def cast_depths(
    scene: World | Room, c2w: np.ndarray, intrinsics: np.ndarray, size: Size
) -> np.ndarray:
    """Return depths (F, H, W) float32: z of the ray through each pixel's centre, 0 in the sky."""
    depths = np.empty((len(c2w), *size), np.float32)

    def band(frame: int, top: int, bottom: int) -> None:
        rows = (bottom - top, size[1], top, 1)
        t, _, _ = trace(*rows, scene.shapes, scene.heights, c2w[frame], intrinsics)
        depths[frame, top:bottom] = np.where(np.isfinite(t), t, 0)

    _in_bands(band, len(c2w), size[0])
    return depths


def _in_bands(draw: Callable[[int, int, int], None], frames: int, height: int) -> None:
    """Call `draw(frame, top, bottom)` for all rows of all frames, on torch's number of threads."""
    tops = range(0, height, _BAND)
    bands = [(frame, top, min(top + _BAND, height)) for frame in range(frames) for top in tops]
    if torch.get_num_threads() == 1:
        for band in bands:
            draw(*band)
        return
    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        # the list raises what a thread raised
        list(pool.map(lambda band: draw(*band), bands))
