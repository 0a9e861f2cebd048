"""Real spherical harmonics of degrees 1 to 3, for colours that depend on the view direction.

Order, signs and factors are those of the 3DGS release (Kerbl et al. 2023, utils/sh_utils.py) and of
gsplat: the order m rises from -l to l within each degree l, with the Condon-Shortley phase. The
formulas are in Sloan, Efficient Spherical Harmonic Evaluation (2013).
"""

import torch
import torch.nn.functional as F
from torch import Tensor

from qgs.precision import full_precision
from qgs.types import SH_COUNTS, Cameras, Gaussians

SH_C0 = 0.28209479177387814
"""Harmonic of degree 0. In 3DGS files, colour = 0.5 + SH_C0 * f_dc with the coefficient f_dc."""
_C1 = 0.4886025119029199
_C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
_C3 = (
    0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154,
    1.445305721320277,
)  # fmt: skip


def harmonics(directions: Tensor, count: int) -> Tensor:
    """Return the values (..., count) of the first `count` real spherical harmonics from degree 1.

    directions: unit vectors (..., 3). count: 3, 8 or 15, for degrees up to 1, 2 or 3.
    """
    x, y, z = directions.unbind(-1)
    xx = x * x
    yy = y * y
    zz = z * z
    values = [-_C1 * y, _C1 * z, -_C1 * x]
    if count > SH_COUNTS[0]:
        a, b, c = _C2
        values += [a * x * y, -a * y * z, b * (2 * zz - xx - yy), -a * x * z, c * (xx - yy)]
    if count > SH_COUNTS[1]:
        a, b, c, d, e = _C3
        values += [-a * y * (3 * xx - yy), b * x * y * z, -c * y * (4 * zz - xx - yy)]
        values += [d * z * (2 * zz - 3 * xx - 3 * yy), -c * x * (4 * zz - xx - yy)]
        values += [e * z * (xx - yy), -a * x * (xx - 3 * yy)]
    return torch.stack(values, -1)


@full_precision
def seen_colors(gaussians: Gaussians, cameras: Cameras) -> Tensor:
    """Return the colours (B, V, G, 3), at least 0, of Gaussians (B, G) from cameras (B, V).

    B, G and V are scenes, Gaussians and views. The colour of Gaussians without `sh` does not depend
    on the camera: the result is (B, 1, G, 3). View directions point from the camera's centre to the
    mean of the Gaussian. The result is differentiable in colors, sh, means and c2w.
    """
    colors = gaussians.colors[:, None]
    if gaussians.sh is not None:
        offsets = gaussians.means[:, None] - cameras.c2w[..., None, :3, 3]
        # Directions from the camera to the Gaussian, as the 3DGS release has them.
        values = harmonics(F.normalize(offsets, dim=-1), gaussians.sh.shape[-2])
        colors = colors + torch.einsum("bvgc,bgcx->bvgx", values, gaussians.sh)
    return colors.clamp_min(0)


@full_precision
def rotated(sh: Tensor, rotation: Tensor) -> Tensor:
    """Rotate the colours that coefficients `sh` (..., C, 3) describe by `rotation` (3, 3).

    C is the number of harmonics. A rotated harmonic is a linear combination of the harmonics of its
    degree. The factors are fitted in float64 to values at random directions.
    """
    directions = torch.randn(64, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    directions = F.normalize(directions, dim=-1)
    count = sh.shape[-2]
    before = harmonics(directions @ rotation.cpu().double(), count)
    return (torch.linalg.pinv(harmonics(directions, count)) @ before).to(sh) @ sh
