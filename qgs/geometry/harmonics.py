"""Real spherical harmonics of degrees 1 to 3: colours that depend on the direction of sight.

Order, signs and factors are those of the 3DGS release (Kerbl et al. 2023, utils/sh_utils.py) and of
gsplat: the order m rises from -l to l in each degree l, with the Condon-Shortley phase. Sloan,
Efficient Spherical Harmonic Evaluation (2013), has the formulas.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

from qgs.precision import full_precision
from qgs.types import SH_COUNTS, Cameras, Gaussians

SH_C0 = 0.28209479177387814
"""The harmonic of degree 0: colour = 0.5 + SH_C0 * f_dc (3DGS release)."""
_C1 = 0.4886025119029199
_C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
_C3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658)
_C3_INNER = (0.3731763325901154, 1.445305721320277)


def harmonics(directions: Tensor, count: int) -> Tensor:
    """The first `count` (3, 8 or 15) functions (..., count) at unit `directions` (..., 3)."""
    x, y, z = directions.unbind(-1)
    xx = x * x
    yy = y * y
    zz = z * z
    values = [-_C1 * y, _C1 * z, -_C1 * x]
    if count > SH_COUNTS[0]:
        a, b, c = _C2
        values += [a * x * y, -a * y * z, b * (2 * zz - xx - yy), -a * x * z, c * (xx - yy)]
    if count > SH_COUNTS[1]:
        a, b, c = _C3
        d, e = _C3_INNER
        values += [-a * y * (3 * xx - yy), b * x * y * z, -c * y * (4 * zz - xx - yy)]
        values += [d * z * (2 * zz - 3 * xx - 3 * yy), -c * x * (4 * zz - xx - yy)]
        values += [e * z * (xx - yy), -a * x * (xx - 3 * yy)]
    return torch.stack(values, -1)


@full_precision
def seen_colors(gaussians: Gaussians, cameras: Cameras) -> Tensor:
    """Colours (B, V, G, 3) of Gaussians (B, G) in cameras (B, V), at least 0.

    Without `sh` they are `colors`, (B, 1, G, 3) for all cameras. The direction is that from a
    camera's centre to a mean. Differentiable in colors, sh, means and c2w.
    """
    if gaussians.sh is None:
        return gaussians.colors[:, None]
    directions = F.normalize(gaussians.means[:, None] - cameras.c2w[..., None, :3, 3], dim=-1)
    # Directions from the camera to the Gaussian, as the 3DGS release has them.
    values = harmonics(directions, gaussians.sh.shape[-2])
    varying = torch.einsum("bvgc,bgcx->bvgx", values, gaussians.sh)
    return (gaussians.colors[:, None] + varying).clamp_min(0)


@full_precision
def rotated(sh: Tensor, rotation: Tensor) -> Tensor:
    """Coefficients (..., C, 3) in a world turned by `rotation` (3, 3), which turns what they paint.

    Turned functions are sums of the others of their degree, whose factors are found in float64
    from values at directions all around.
    """
    directions = torch.randn(64, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    directions = F.normalize(directions, dim=-1)
    count = sh.shape[-2]
    before = harmonics(directions @ rotation.cpu().double(), count)
    return (torch.linalg.pinv(harmonics(directions, count)) @ before).to(sh) @ sh
