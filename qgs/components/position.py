"""The activation that places things in space."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from qgs.geometry.precision import full_precision


@full_precision
def posact(
    t: Tensor, input_limit: float | None = None, output_limit: float | None = None
) -> Tensor:
    """sign(t) (exp|t| - 1): linear near 0, exponential far out (TokenGS release).

    input_limit clamps t, output_limit the result (LocusGS release: 100 and 1000; TokenGS: none).
    The slope at 0 is 1, so that a head which starts at zero can learn; it is 0 beyond a limit.
    """
    if input_limit is not None:
        t = t.clamp(-input_limit, input_limit)
    if output_limit is not None:
        beyond = math.log1p(output_limit) + 1  # an exponential that overflows has slope 0 * inf
        t = t.clamp(-beyond, beyond)
    result = torch.where(t >= 0, torch.expm1(t), -torch.expm1(-t))
    return result if output_limit is None else result.clamp(-output_limit, output_limit)
