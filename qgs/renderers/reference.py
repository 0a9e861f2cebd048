"""`qgs/torch`: the dense reference in autograd, every Gaussian at every pixel.

EWA projection after Zwicker et al. 2001 and gsplat 1.5.3.
"""

from dataclasses import dataclass
from itertools import product

import torch
import torch.nn.functional as F
from torch import Tensor

from qgs.contracts import Renderer, RendererConfig
from qgs.contracts.renderer import background_of, check_inputs, colors_of, raise_precision
from qgs.geometry.transforms import quat_to_matrix
from qgs.types import Cameras, Gaussians, Rendering

# Of the image's width or height: beyond it the Jacobian is held constant.
CLAMP_MARGIN = 0.15


@dataclass(frozen=True)
class Splats:
    """Gaussians as cameras see them, each field (B, V, G, ...).

    means: (..., 2) pixels. conics: (..., 3) entries xx, xy, yy of the inverse covariance, pixel^-2.
    depths: camera-frame z. visible: False for what near, far or an overflow drops; the other fields
    are finite placeholders there, with zero gradients.
    """

    means: Tensor
    conics: Tensor
    depths: Tensor
    visible: Tensor


def project(
    gaussians: Gaussians, cameras: Cameras, near: float, far: float, dilation: float
) -> Splats:
    """Splats (B, V, G) of Gaussians (B, G) in cameras (B, V) of one dtype, autocast being off.

    Differentiable in means, scales, quats (normalised here), c2w and intrinsics. In the Jacobian,
    x/z and y/z are clamped to 15 % of the image beyond its borders, as gsplat does.
    """
    w2c = cameras.w2c
    turns = quat_to_matrix(F.normalize(gaussians.quats, dim=-1))
    factors = turns * gaussians.scales[..., None, :]  # (B, G, 3, 3)
    position = w2c[..., :3, :3] @ gaussians.means.mT[:, None] + w2c[..., :3, 3:]
    x, y, z = position.unbind(-2)  # (B, V, G) each
    in_range = (z >= near) & (z <= far)
    # Placeholders where nothing is drawn: a NaN there would reach every gradient through 0 * NaN.
    z = torch.where(in_range, z, 1.0)
    x, y = (torch.where(in_range, value, 0.0) / z for value in (x, y))

    fx, fy, cx, cy = cameras.intrinsics[..., None, :].unbind(-1)  # (B, V, 1) each
    height, width = cameras.size
    means = torch.stack([torch.addcmul(cx, fx, x), torch.addcmul(cy, fy, y)], -1)
    # Far off screen the linear Jacobian would blow a Gaussian up over the whole image.
    x = _clamped(x, fx, cx, width)
    y = _clamped(y, fy, cy, height)

    turned = w2c[..., :3, :3] @ factors.permute(0, 2, 1, 3).flatten(2)[:, None]
    rows = turned.unflatten(-1, (-1, 3))  # (B, V, 3, G, 3): rows of W R S
    row_x = (fx / z)[..., None] * (rows[:, :, 0] - x[..., None] * rows[:, :, 2])
    row_y = (fy / z)[..., None] * (rows[:, :, 1] - y[..., None] * rows[:, :, 2])
    xx = (row_x * row_x).sum(-1)
    xy = (row_x * row_y).sum(-1)
    yy = (row_y * row_y).sum(-1)
    minors = torch.linalg.cross(row_x, row_y, dim=-1)
    # Cauchy-Binet: unlike xx * yy - xy^2 this does not cancel for needles.
    determinant = (minors * minors).sum(-1) + dilation * (xx + yy) + dilation * dilation
    usable = torch.isfinite(determinant) & (determinant > 0)
    determinant = torch.where(usable, determinant, 1.0)
    conics = torch.stack([yy + dilation, -xy, xx + dilation], -1) / determinant[..., None]
    conics = torch.where(usable[..., None], conics, 0.0)
    return Splats(means, conics, z, in_range & usable)


def _clamped(slope: Tensor, focal: Tensor, principal: Tensor, size: int) -> Tensor:
    margin = CLAMP_MARGIN * size
    low = (-margin - principal) / focal
    high = (size + margin - principal) / focal
    return torch.minimum(torch.maximum(slope, low), high)


class TorchRenderer(Renderer):
    """The reference for tests: any device, float32 or float64, time and memory G x H x W.

    Gaussians at the same depth are drawn in their given order.
    """

    name = "torch"

    def forward(
        self, gaussians: Gaussians, cameras: Cameras, background: Tensor | None = None
    ) -> Rendering:
        """See `Renderer`; half-precision inputs are rendered in float32."""
        check_inputs(gaussians, cameras)
        config = self.config
        with torch.autocast(gaussians.means.device.type, enabled=False):
            gaussians, cameras = raise_precision(gaussians, cameras)
            backdrop = background_of(background, config.background, gaussians.means)
            splats = project(gaussians, cameras, config.near, config.far, config.dilation)
            colors = colors_of(gaussians, cameras)
            sums = [
                _composite(splats, gaussians, colors, image, cameras.size, config)
                for image in product(range(cameras.shape[0]), range(cameras.shape[1]))
            ]
            sums = torch.stack(sums).unflatten(0, cameras.shape)
            features = None if gaussians.features is None else sums[:, :, 5:]
            return resolve(sums[:, :, :5], backdrop, features)


def resolve(sums: Tensor, background: Tensor, features: Tensor | None = None) -> Rendering:
    """Sums (B, V, 5, H, W) of w r, w g, w b, w z, w, and those of features -> Rendering."""
    rgb, depth, alpha = sums.split([3, 1, 1], dim=2)
    # Depth is 0, not NaN, where nothing was hit.
    hit = torch.where(alpha > 0, alpha, 1.0)
    rgb = rgb + (1 - alpha) * background[:, None, None]
    return Rendering(rgb=rgb, alpha=alpha, depth=depth / hit, features=features)


def _composite(
    splats: Splats,
    gaussians: Gaussians,
    colors: Tensor,
    image: tuple[int, int],
    size: tuple[int, int],
    config: RendererConfig,
) -> Tensor:
    """Sums (5 + F, H, W) of one image (scene, view), front to back.

    colors: (B, G, 3) or (B, V, G, 3).
    """
    height, width = size
    # Front to back; equal depths stay in order.
    order = splats.depths[image].argsort(stable=True)
    order = order[splats.visible[image][order]]
    means, conics, depths = (
        field[image][order] for field in (splats.means, splats.conics, splats.depths)
    )
    opacities = gaussians.opacities[image[0]][order]
    # Pixel centres are at .5: (0, 0) is the corner of the image.
    u = torch.arange(width, dtype=means.dtype, device=means.device) + 0.5
    v = torch.arange(height, dtype=means.dtype, device=means.device) + 0.5
    # (G, 1, W), (G, H, 1)
    dx = u - means[:, None, :1]
    dy = v[:, None] - means[:, 1:, None]
    xx, xy, yy = conics[..., None, None].unbind(1)
    power = -0.5 * (xx * dx * dx + yy * dy * dy) - xy * dx * dy
    alphas = opacities[:, None, None] * power.clamp(max=0).exp()
    # alpha_min: less changes no 8-bit image. The cap: gradients divide by 1 - alpha.
    alphas = torch.where(alphas >= config.alpha_min, alphas.clamp(max=config.alpha_cap), 0.0)
    after = torch.cumprod(1 - alphas, 0)
    before = torch.cat([torch.ones_like(after[:1]), after[:-1]])[: len(order)]
    # `after`, not `before`: a Gaussian that would close the pixel is left out, as in gsplat.
    weights = torch.where(after > config.transmittance_min, alphas * before, 0.0)
    colors = colors[image[: colors.ndim - 2]][order]
    z = depths[:, None]
    summed = [colors, z, torch.ones_like(z)]
    if gaussians.features is not None:
        summed.append(gaussians.features[image[0]][order])
    return torch.einsum("ghw,gc->chw", weights, torch.cat(summed, 1))
