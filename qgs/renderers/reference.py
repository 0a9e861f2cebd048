"""`qgs/torch`: the dense reference, every Gaussian at every pixel."""

from __future__ import annotations

import torch
from torch import Tensor

from qgs.contracts import Renderer, RendererConfig
from qgs.renderers.inputs import background_of, check_inputs, raise_precision
from qgs.renderers.projection import Splats, project
from qgs.types import Cameras, Gaussians, Rendering


class TorchRenderer(Renderer):
    """The oracle: any device, float32 or float64, memory and time G x H x W per camera.

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
            height, width = cameras.size
            sums = [
                _composite(splats, gaussians, (b, v), height, width, config)
                for b in range(cameras.shape[0])
                for v in range(cameras.shape[1])
            ]
            sums = torch.stack(sums).reshape(*cameras.shape, 5, height, width)
            return resolve(sums, backdrop)


def resolve(sums: Tensor, background: Tensor) -> Rendering:
    """Sums (B, V, 5, H, W) of w r, w g, w b, w z and w into a Rendering."""
    rgb, depth, alpha = sums.split([3, 1, 1], dim=2)
    hit = torch.where(alpha > 0, alpha, 1.0)
    return Rendering(
        rgb=rgb + (1 - alpha) * background[:, None, None],
        alpha=alpha,
        depth=depth / hit,
    )


def _composite(
    splats: Splats,
    gaussians: Gaussians,
    image: tuple[int, int],
    height: int,
    width: int,
    config: RendererConfig,
) -> Tensor:
    """Sums (5, H, W) of one image, front to back."""
    order = splats.depths[image].argsort(stable=True)
    order = order[splats.visible[image][order]]
    means, conics, depths = (
        field[image][order] for field in (splats.means, splats.conics, splats.depths)
    )
    opacities, colors = gaussians.opacities[image[0]][order], gaussians.colors[image[0]][order]
    u = torch.arange(width, dtype=means.dtype, device=means.device) + 0.5
    v = torch.arange(height, dtype=means.dtype, device=means.device) + 0.5
    dx, dy = u - means[:, None, :1], v[:, None] - means[:, 1:, None]  # (G, 1, W), (G, H, 1)
    xx, xy, yy = conics[..., None, None].unbind(1)
    power = -0.5 * (xx * dx * dx + yy * dy * dy) - xy * dx * dy
    alphas = opacities[:, None, None] * power.clamp(max=0).exp()
    alphas = torch.where(alphas >= config.alpha_min, alphas.clamp(max=config.alpha_cap), 0.0)
    after = torch.cumprod(1 - alphas, 0)
    before = torch.cat([torch.ones_like(after[:1]), after[:-1]])[: len(order)]
    weights = torch.where(after > config.transmittance_min, alphas * before, 0.0)
    features = torch.cat([colors, depths[:, None], torch.ones_like(depths[:, None])], 1)
    return torch.einsum("ghw,gc->chw", weights, features)
