"""Gaussians as .splat files, for viewers in the browser: 32 bytes each, no spherical harmonics.

Source: github.com/antimatter15/splat, convert.py, whose order of bytes and Gaussians this is.
"""

from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from qgs.data.scenes import warn_once
from qgs.io.files import replacing
from qgs.io.ply import one_scene
from qgs.types import Gaussians
from qgs.wording import listed

RECORD = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])


def save_splat(gaussians: Gaussians, path: str | Path) -> None:
    """Write one scene, (G, ...) or (1, G, ...), the largest and most opaque Gaussians first.

    Colours, opacities and quaternions, w x y z, get 8 bits. A warning says that spherical harmonics
    and features are left out. The file appears whole or not at all. Raises as `save_ply`.
    """
    scene = one_scene(gaussians, ".splat")
    left = {"spherical harmonics (`sh`)": scene.sh, "features": scene.features}
    if lost := [name for name, tensor in left.items() if tensor is not None]:
        warn_once(f".splat files have no place for {listed(lost)}: left out, `colors` are stored")
    first = (scene.scales.prod(-1) * scene.opacities).argsort(descending=True, stable=True)
    scene = scene[first]
    records = np.empty(scene.count, RECORD)
    records["mean"], records["scale"] = scene.means, scene.scales
    records["rgba"] = _bytes(torch.cat([scene.colors, scene.opacities[:, None]], -1) * 255)
    records["quat"] = _bytes(F.normalize(scene.quats, dim=-1) * 128 + 128)
    with replacing(path) as temporary:
        temporary.write_bytes(records.tobytes())


def _bytes(values: Tensor) -> Tensor:
    return values.round().clamp(0, 255).byte()
