"""Gaussians from the PLY files that qgs writes."""

from pathlib import Path

import numpy as np
import torch
from plyfile import PlyData

from qgs.io.ply import SH_C0
from qgs.types import Gaussians


def read_ply(path: Path) -> Gaussians:
    """The (1, G, ...) Gaussians of a 3DGS file without view-dependent colour."""
    vertices = PlyData.read(str(path))["vertex"].data

    def columns(*names: str) -> torch.Tensor:
        return torch.from_numpy(np.stack([vertices[name] for name in names], -1))

    return Gaussians(
        means=columns("x", "y", "z"),
        scales=columns("scale_0", "scale_1", "scale_2").exp(),
        quats=columns("rot_0", "rot_1", "rot_2", "rot_3"),
        opacities=columns("opacity")[:, 0].sigmoid(),
        colors=columns("f_dc_0", "f_dc_1", "f_dc_2") * SH_C0 + 0.5,
    )[None]
