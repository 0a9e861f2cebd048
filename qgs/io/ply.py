"""Gaussians as PLY files that splat viewers open (property names and order: 3DGS release)."""

from pathlib import Path

import numpy as np
import torch
from plyfile import PlyData, PlyElement

from qgs.io.files import replacing
from qgs.types import Gaussians

SH_C0 = 0.28209479177387814
"""The spherical harmonic of degree 0: colour = 0.5 + SH_C0 * f_dc (3DGS release)."""

OPACITY_EPS = 1e-6
"""Opacities are kept this far from 0 and 1, where the logit is infinite."""

SCALE_MIN = 1e-12
"""Smallest scale stored, world units: the logarithm of 0 is infinite."""

PROPERTIES = (
    "x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity",
    "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3",
)  # fmt: skip


def write_ply(gaussians: Gaussians, path: str | Path) -> None:
    """Write one scene, (G, ...) or (1, G, ...), as binary little-endian float32.

    Colours become f_dc, opacities logits, scales logarithms; quaternions stay w x y z; normals are
    zero. The file appears whole or not at all. Raises ValueError for several scenes or for numbers
    that are not finite.
    """
    batch = gaussians.means.shape[:-2]
    if batch not in ((), (1,)):
        raise ValueError(
            f"a PLY file holds one scene, got Gaussians of batch shape {tuple(batch)}; "
            "write them one by one, as gaussians[i]"
        )
    scene = gaussians[0] if batch else gaussians
    parts = [
        scene.means,
        torch.zeros_like(scene.means),
        (scene.colors - 0.5) / SH_C0,
        scene.opacities.clamp(OPACITY_EPS, 1 - OPACITY_EPS).logit()[:, None],
        scene.scales.clamp_min(SCALE_MIN).log(),
        scene.quats,
    ]
    table = torch.cat([part.detach().float().cpu() for part in parts], -1)
    broken = int((~table.isfinite()).any(-1).sum())
    if broken:
        raise ValueError(f"{broken} of {len(table)} Gaussians have numbers that are not finite")
    vertices = np.empty(len(table), dtype=[(name, "<f4") for name in PROPERTIES])
    for column, name in enumerate(PROPERTIES):
        vertices[name] = table[:, column]
    with replacing(path) as temporary, temporary.open("wb") as file:
        PlyData([PlyElement.describe(vertices, "vertex")], byte_order="<").write(file)
