"""Photos of the inside of a textured box, with exact cameras, for matching features."""

from typing import NamedTuple

import numpy as np
import photo_formats
import torch
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation
from walk import pinhole

from qgs.types import Views

SIZE = (120, 180)
INTRINSICS = (145.0, 147.0, 89.0, 61.0)


class Shot(NamedTuple):
    """image: (H, W, 3) uint8. c2w: (4, 4) OpenCV camera-to-world."""

    image: np.ndarray
    c2w: np.ndarray

    def encoded(self):
        return photo_formats.encoded(self.image, "JPEG", quality=92)


def walk(count, scale=1):
    """Photos along a rising arc that turns and rolls, so that no convention is ambiguous.

    scale: of their size, over SIZE.
    """
    noise = np.random.default_rng(0).random((40, 40, 40))
    return [_shot(noise, pose, scale) for pose in _poses(count)]


def photos_of(shots):
    """Photos (1, V) and their cameras, in float32."""
    images, c2w = map(np.stack, zip(*shots, strict=True))
    cameras = pinhole(torch.tensor(c2w).float(), INTRINSICS, SIZE)
    return Views((torch.tensor(images).movedim(-1, 1) / 255)[None], cameras[None])


def _poses(count):
    poses = []
    for place in np.linspace(0, 1, count):
        angles = 0.5 * place - 0.2, 0.15 - 0.3 * place, 0.25 * place
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("YXZ", angles).as_matrix()
        pose[:3, 3] = 0.9 * place - 0.4, 0.3 * np.sin(4 * place), 0.5 * place - 0.6
        poses.append(pose)
    return poses


def _shot(noise, pose, scale):
    """Every pixel's ray meets the box's walls, at 1.2, 1 and 1.5 from the origin, from inside.

    They are cut out of a block of noise.
    """
    fx, fy, cx, cy = scale * np.array(INTRINSICS)
    y, x = np.mgrid[: scale * SIZE[0], : scale * SIZE[1]] + 0.5
    rays = np.stack([(x - cx) / fx, (y - cy) / fy, np.ones_like(x)], -1) @ pose[:3, :3].T
    half = np.array([1.2, 1.0, 1.5])
    reach = ((np.sign(rays) * half - pose[:3, 3]) / rays).min(-1)
    hit = (pose[:3, 3] + rays * reach[..., None]) / half
    grey = map_coordinates(noise, np.moveaxis((hit + 1) * 19.5, -1, 0), order=1, mode="nearest")
    return Shot((grey[..., None] * [255, 230, 204]).astype(np.uint8), pose)
