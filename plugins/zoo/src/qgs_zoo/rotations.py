"""Quaternions, w x y z, of rotation matrices."""

import torch
import torch.nn.functional as F
from torch import Tensor

from qgs.geometry.precision import full_precision


@full_precision
def quaternions(rotations: Tensor) -> Tensor:
    """Unit quaternions (..., 4), up to sign, of rotation matrices (..., 3, 3)."""
    (a, b, c), (d, e, f), (g, h, i) = (row.unbind(-1) for row in rotations.unbind(-2))
    # 4 q q^T: every row is the quaternion times four of its numbers; the longest loses no digits.
    outer = [
        1 + a + e + i, h - f, c - g, d - b,
        h - f, 1 + a - e - i, d + b, c + g,
        c - g, d + b, 1 - a + e - i, h + f,
        d - b, c + g, h + f, 1 - a - e + i,
    ]  # fmt: skip
    rows = torch.stack(outer, -1).unflatten(-1, (4, 4))
    longest = rows.diagonal(dim1=-2, dim2=-1).argmax(-1)[..., None, None]
    row = rows.gather(-2, longest.expand(*longest.shape[:-1], 4)).squeeze(-2)
    return F.normalize(row, dim=-1)
