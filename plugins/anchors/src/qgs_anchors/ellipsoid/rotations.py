"""Rotations as quaternions, w x y z."""

import torch
import torch.nn.functional as F
from torch import Tensor

from qgs.geometry.constants import constant
from qgs.geometry.precision import full_precision
from qgs.geometry.transforms import quat_product

IDENTITY = (1.0, 0.0, 0.0, 0.0)


def unit(v: Tensor, otherwise: tuple[float, ...]) -> Tensor:
    """Vectors (..., C) of length 1; `otherwise` for those of length 0."""
    length = v.norm(dim=-1, keepdim=True)
    return torch.where(length > 0, v / torch.where(length > 0, length, 1), constant(otherwise, v))


@full_precision
def unit_quats(quats: Tensor) -> Tensor:
    """Quaternions (..., 4) of length 1; the identity for those of length 0."""
    return unit(quats, IDENTITY)


@full_precision
def turned(quats: Tensor, turn: Tensor) -> Tensor:
    """Unit quaternions (..., 4) of `quats` turned about world axes by `turn` (..., 3).

    turn / 2 is the Gibbs vector of the rotation: it turns about `turn` by 2 atan(|turn| / 2), which
    is |turn| radians while that is small and never half a turn (Cayley transform).
    """
    small = torch.cat([torch.ones_like(turn[..., :1]), turn / 2], -1)
    return F.normalize(quat_product(F.normalize(small, dim=-1), quats), dim=-1)
