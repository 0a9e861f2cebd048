"""Gaussians as .splat files, for viewers in the web: 32 bytes each."""

from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from qgs.checkpoint.gaussians import one_scene
from qgs.files import replacing
from qgs.types import Gaussians

SPLAT = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])
"""A Gaussian of a .splat file, 32 bytes. Source: github.com/antimatter15/splat, convert.py."""


def save_splat(gaussians: Gaussians, path: str | Path) -> None:
    """Write one scene, (G, ...) or (1, G, ...), the largest and most opaque Gaussians first.

    Colours, opacities and quaternions, w x y z, get 8 bits. Warns that spherical harmonics and
    `features` are left out. Raises as `save_ply`.
    """
    scene = one_scene(gaussians, ".splat", "sh", "features")
    # Viewers draw a file while it loads, so what covers most comes first.
    first = (scene.scales.prod(-1) * scene.opacities).argsort(descending=True, stable=True)
    scene = scene[first]

    def as_bytes(values: Tensor) -> Tensor:
        return values.round().clamp(0, 255).byte()

    records = np.empty(scene.count, SPLAT)
    records["mean"], records["scale"] = scene.means, scene.scales
    records["rgba"] = as_bytes(torch.cat([scene.colors, scene.opacities[:, None]], -1) * 255)
    records["quat"] = as_bytes(F.normalize(scene.quats, dim=-1) * 128 + 128)
    with replacing(path) as temporary:
        temporary.write_bytes(records.tobytes())
