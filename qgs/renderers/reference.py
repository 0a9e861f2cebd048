"""`qgs/torch`, a reference renderer with autograd that computes every Gaussian at every pixel.

The EWA projection follows Zwicker et al. 2001 and gsplat 1.5.3.
"""

from itertools import product

import torch
import torch.nn.functional as F
from torch import Tensor

from qgs.contracts import Renderer, RendererConfig
from qgs.geometry.constants import constant
from qgs.geometry.transforms import quat_to_matrix, to_camera, to_pixels
from qgs.types import Cameras, Gaussians, Rendering, Size

# Fraction of the image's width or height; farther outside, the Jacobian is constant.
CLAMP_MARGIN = 0.15


def project(
    gaussians: Gaussians, cameras: Cameras, near: float, far: float, dilation: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Project Gaussians (B, G) to cameras (B, V) of the same dtype; autocast must be off.

    Returns pixels (B, V, G, 2); entries xx, xy, yy (B, V, G, 3) of inverse covariances, pixel^-2;
    depths (B, V, G), camera-frame z; and visibility (B, V, G), bool. A Gaussian is invisible if it
    is nearer than `near` or farther than `far`, or if its covariance overflows; its pixel,
    covariance and depth are then finite placeholders with zero gradients. Differentiable in means,
    scales, quats (normalised here), c2w and intrinsics.
    """
    centres = to_camera(gaussians.means, cameras)  # (B, V, G, 3)
    in_range = (centres[..., 2] >= near) & (centres[..., 2] <= far)
    # Placeholders for undrawn Gaussians: a NaN would reach every gradient through 0 * NaN.
    centres = torch.where(in_range[..., None], centres, constant([0.0, 0.0, 1.0], centres))
    rotations = quat_to_matrix(F.normalize(gaussians.quats, dim=-1))
    in_world = rotations * gaussians.scales[..., None, :]  # R S, (B, G, 3, 3)
    in_camera = cameras.w2c[..., None, :3, :3] @ in_world[:, None]  # W R S, (B, V, G, 3, 3)
    with torch.no_grad():
        _, usable = _conics(in_camera, centres, cameras, dilation)
    # Before anything can overflow: where() after it would pass on gradients 0 * inf.
    drawn = torch.where(usable[..., None, None], in_camera, 0.0)
    conics, _ = _conics(drawn, centres, cameras, dilation)
    means = to_pixels(centres, cameras.intrinsics)
    return means, conics, centres[..., 2], in_range & usable


def _conics(
    factors: Tensor, centres: Tensor, cameras: Cameras, dilation: float
) -> tuple[Tensor, Tensor]:
    """Return the entries xx, xy, yy (B, V, G, 3) of inverse 2D covariances, and a bool mask.

    The mask (B, V, G) is False where the inverse does not exist. The covariance is F F^T +
    dilation * I, with F = J W R S: J is the Jacobian of the projection, W the rotation to the
    camera, R and S rotation and scales of a Gaussian. factors: W R S (B, V, G, 3, 3).
    centres: camera-frame means (B, V, G, 3). In J, x/z and y/z are clamped to 15 % of the image
    beyond its borders, as in gsplat. Without clamping, a Gaussian farther off screen could spread
    over the whole image.
    """
    focal, principal = cameras.intrinsics[:, :, None].split(2, -1)
    sides = cameras.size[::-1]
    low = constant([-CLAMP_MARGIN * side for side in sides], centres)
    high = constant([side + CLAMP_MARGIN * side for side in sides], centres)
    z = centres[..., 2:]
    slopes = torch.maximum(centres[..., :2] / z, (low - principal) / focal)
    slopes = torch.minimum(slopes, (high - principal) / focal)[..., None]
    rows = (focal / z)[..., None] * (factors[..., :2, :] - slopes * factors[..., 2:, :])
    row_x, row_y = rows.unbind(-2)
    xx = (row_x * row_x).sum(-1)
    xy = (row_x * row_y).sum(-1)
    yy = (row_y * row_y).sum(-1)
    minors = torch.linalg.cross(row_x, row_y)
    # Cauchy-Binet: unlike xx * yy - xy^2 this does not cancel for needles.
    determinant = (minors * minors).sum(-1) + dilation * (xx + yy) + dilation * dilation
    usable = torch.isfinite(determinant) & (determinant > 0)
    divisor = torch.where(usable, determinant, 1.0)[..., None]
    return torch.stack([yy + dilation, -xy, xx + dilation], -1) / divisor, usable


class TorchRenderer(Renderer):
    """Reference renderer for tests, on any device, in float32 or float64.

    Time and memory grow with G x H x W, Gaussians times pixels. Gaussians at the same depth are
    blended in the order in which they are given.
    """

    name = "torch"

    def draw(
        self, gaussians: Gaussians, cameras: Cameras, channels: Tensor, backdrop: Tensor
    ) -> Rendering:
        """Render every scene from each of its cameras; half-precision inputs become float32."""
        config = self.config
        means, conics, depths, visible = project(
            gaussians, cameras, config.near, config.far, config.dilation
        )
        channels = channels.expand(-1, cameras.shape[1], -1, -1)
        sums = []
        for image in product(*map(range, cameras.shape)):
            # Front to back; equal depths stay in order.
            order = depths[image].argsort(stable=True)
            order = order[visible[image][order]]
            z = depths[image][order][:, None]
            weights = _weights(
                means[image][order],
                conics[image][order],
                gaussians.opacities[image[0]][order],
                cameras.size,
                config,
            )
            summed = torch.cat([channels[image][order], z, torch.ones_like(z)], 1)
            sums.append(torch.einsum("ghw,gc->chw", weights, summed))
        return resolve(torch.stack(sums).unflatten(0, cameras.shape), backdrop)


def resolve(sums: Tensor, background: Tensor) -> Rendering:
    """Convert sums (B, V, C, H, W) over Gaussians to a Rendering over `background`.

    The C channels are r, g, b, features, z and 1, each multiplied by the weight of the Gaussian.
    """
    rgb, features, depth, alpha = sums.tensor_split([3, sums.shape[2] - 2, sums.shape[2] - 1], 2)
    # Depth is 0, not NaN, where nothing was hit.
    hit = torch.where(alpha > 0, alpha, 1.0)
    return Rendering(
        rgb=rgb + (1 - alpha) * background[:, None, None],
        alpha=alpha,
        depth=depth / hit,
        features=features if features.shape[2] else None,
    )


def _weights(
    means: Tensor,
    conics: Tensor,
    opacities: Tensor,
    size: Size,
    config: RendererConfig,
) -> Tensor:
    """Return the blending weights (G, H, W) of splats at all pixels of an image.

    means, conics, opacities: values of the splats (G, ...), sorted front to back.
    """
    # Pixel centres are at .5: (0, 0) is the corner of the image.
    v, u = (torch.arange(side, dtype=means.dtype, device=means.device) + 0.5 for side in size)
    # (G, 1, W), (G, H, 1)
    dx = u - means[:, None, :1]
    dy = v[:, None] - means[:, 1:, None]
    xx, xy, yy = conics[..., None, None].unbind(1)
    power = -0.5 * (xx * dx * dx + yy * dy * dy) - xy * dx * dy
    alphas = opacities[:, None, None] * power.clamp(max=0).exp()
    # Alpha below alpha_min changes no 8-bit image. The cap: gradients divide by 1 - alpha.
    alphas = torch.where(alphas >= config.alpha_min, alphas.clamp(max=config.alpha_cap), 0.0)
    after = torch.cumprod(1 - alphas, 0)
    before = F.pad(after, (0, 0, 0, 0, 1, 0), value=1.0)[:-1]
    # `after`, not `before`: a Gaussian that would close the pixel is left out, as in gsplat.
    return torch.where(after > config.transmittance_min, alphas * before, 0.0)
