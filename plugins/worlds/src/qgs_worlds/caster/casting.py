"""Cast all rays of images in parallel: depth maps and colours of procedural scenes."""

from collections.abc import Callable
from itertools import product

import numpy as np

from qgs.machine import in_threads
from qgs.types import Size
from qgs_worlds.caster.raycast import trace
from qgs_worlds.caster.tables import Room, World

# Rows of an image that one thread casts at a time: small enough to share, and to stay in its cache.
_BAND = 64


def cast(
    scene: World | Room,
    c2w: np.ndarray,
    intrinsics: np.ndarray,
    size: Size,
    samples: int = 1,
    paint: Callable[..., None] | None = None,
    kind: type[np.number] = np.float32,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the depth of every ray, (F, samples * H, samples * W) float32, and images, of F views.

    Depth is z in the camera frame; a ray into the sky has depth inf. c2w: poses (F, 4, 4) with
    OpenCV axes. intrinsics: fx, fy, cx, cy in pixels, the same for all cameras. samples: rays per
    pixel along each axis. paint: kernel that colours the images (F, H, W, 3), of type `kind`, band
    by band; a pixel is the mean of its rays. Without `paint` the images have no content.
    """
    height, width = size
    depths = np.empty((len(c2w), samples * height, samples * width), np.float32)
    images = np.empty((len(c2w), height, width, 3), kind)

    def band(frame: int, top: int) -> None:
        rows = min(_BAND, height - top)
        area = (rows, width, top, samples)
        t, code, rays = trace(*area, scene.shapes, scene.heights, c2w[frame], intrinsics)
        depths[frame, samples * top : samples * (top + rows)] = t
        if paint:
            painted = images[frame, top : top + rows]
            paint(painted, t, code, top, samples, scene, c2w[frame], rays)

    in_threads(band, product(range(len(c2w)), range(0, height, _BAND)))
    return depths, images
