"""Candidates merged by gates, 6D rotations: the arithmetic of GlobalSplat's head.

Axes: B scenes, N tokens, C candidates of a token, G Gaussians of a token.
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from qgs.geometry.precision import full_precision

LEAST_LENGTH = 1e-4
"""What a vector is divided by at least when it is made a unit one."""


@full_precision
def merged(candidates: Tensor, gates: Tensor, count: int) -> Tensor:
    """Blocks of C / count candidates, averaged by the softmax of their gates.

    candidates: (..., C, X). gates: (..., C). Returns (..., count, X).
    """
    weights = gates.unflatten(-1, (count, -1)).softmax(-1)
    return (weights[..., None] * candidates.unflatten(-2, (count, -1))).sum(-2)


def growth(candidates: int, count: int) -> float:
    """Added to the log scales of `count` Gaussians merged of `candidates`: they fill one volume."""
    return math.log(candidates / count) / 3


def stages(level: float) -> list[tuple[int, float]]:
    """Numbers of Gaussians that are shown at s = `level`, and the share of each.

    2^s with the share 1 for a whole s; else those of both neighbours, blended.
    """
    low = math.floor(level)
    share = level - low
    return [(2**low, 1 - share), (2 ** (low + 1), share)] if share else [(2**low, 1.0)]


@full_precision
def rotation_6d(vectors: Tensor) -> Tensor:
    """Unit quaternions (..., 4), w x y z, of the rotations whose first two columns are nearest.

    vectors: (..., 6), two columns, orthonormalised in their order (Zhou et al. 2019). Where they do
    not tell a rotation (zeros, parallel ones) the quaternion is a unit one still.
    """
    first, second = vectors.split(3, -1)
    first = F.normalize(first, dim=-1, eps=LEAST_LENGTH)
    second = second - (first * second).sum(-1, keepdim=True) * first
    second = F.normalize(second, dim=-1, eps=LEAST_LENGTH)
    third = torch.linalg.cross(first, second, dim=-1)
    return quaternions(torch.stack([first, second, third], -1))


@full_precision
def quaternions(matrices: Tensor) -> Tensor:
    """Unit quaternions (..., 4), w x y z, of rotation matrices (..., 3, 3).

    With q the quaternion, 4 q q' is linear in the matrix; its longest row is taken, so that none is
    divided by a small number.
    """
    (a, b, c), (d, e, f), (g, h, i) = (row.unbind(-1) for row in matrices.unbind(-2))
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
