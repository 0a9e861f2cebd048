"""`qgs/gsplat`, a renderer that uses the CUDA kernels of gsplat 1.5.3."""

from collections.abc import Iterable
from importlib import import_module
from importlib.util import find_spec

import torch
import torch.nn.functional as F
from torch import Tensor

from qgs.contracts import (
    ComponentConfig,
    MissingExtraError,
    Problem,
    RecipeContext,
    Renderer,
    RendererConfig,
)
from qgs.renderers.reference import TorchRenderer
from qgs.types import Cameras, Gaussians, Rendering


class GsplatRenderer(Renderer):
    """Renderer for float32 tensors on CUDA.

    gsplat has no gradient for intrinsics, so intrinsics that require a gradient are refused. Its
    kernels fix alpha_min, alpha_cap and transmittance_min at the defaults of these options.
    """

    name = "gsplat"
    devices = ("cuda",)
    camera_gradients = ("c2w",)

    def __init__(self, config: RendererConfig) -> None:
        super().__init__(config)
        for problem in self.problems(config):
            raise ValueError(f"{problem.option}: {problem.reason}; {problem.fix}")

    @classmethod
    def problems(
        cls, config: ComponentConfig, context: RecipeContext | None = None
    ) -> Iterable[Problem]:
        """Return a problem for each option that differs from its fixed value in the kernels."""
        defaults = RendererConfig()
        return [
            Problem(
                option,
                f"gsplat's kernels fix this option at {getattr(defaults, option):g}, "
                f"got {getattr(config, option):g}",
                "remove the option, or choose qgs/torch or qgs/cpu as renderer",
            )
            for option in ("alpha_min", "alpha_cap", "transmittance_min")
            if getattr(config, option) != getattr(defaults, option)
        ]

    def draw(
        self, gaussians: Gaussians, cameras: Cameras, channels: Tensor, backdrop: Tensor
    ) -> Rendering:
        """Render every scene from each of its cameras.

        Raises ValueError for tensors that are not on CUDA, and RuntimeError if gsplat is missing.
        """
        _check_supported(gaussians, cameras)
        # gsplat's kernels divide by their number.
        if not gaussians.means.shape[1]:
            return TorchRenderer(self.config).draw(gaussians, cameras, channels, backdrop)
        # Imported late: it needs CUDA.
        rasterization = import_module("gsplat").rasterization

        # Features are over 0.
        backdrop = F.pad(backdrop, (0, channels.shape[-1] - 3))
        height, width = cameras.size
        focal, principal = cameras.intrinsics.split(2, -1)
        calibration = torch.diag_embed(F.pad(focal, (0, 1), value=1.0))
        calibration[..., :2, 2] = principal
        # The packed path asserts with backgrounds and can mix gradients between scenes.
        rgbd, alpha, _ = rasterization(
            means=gaussians.means,
            quats=gaussians.quats,
            scales=gaussians.scales,
            opacities=gaussians.opacities,
            colors=channels.expand(-1, cameras.shape[1], -1, -1),
            viewmats=cameras.w2c,
            Ks=calibration,
            width=width,
            height=height,
            near_plane=self.config.near,
            far_plane=self.config.far,
            eps2d=self.config.dilation,
            packed=False,
            backgrounds=backdrop.expand(*cameras.shape, -1).contiguous(),
            render_mode="RGB+ED",
        )
        images = rgbd.movedim(-1, -3)
        return Rendering(
            rgb=images[..., :3, :, :],
            alpha=alpha.movedim(-1, -3),
            depth=images[..., -1:, :, :],
            features=None if gaussians.features is None else images[..., 3:-1, :, :],
        )


def _check_supported(gaussians: Gaussians, cameras: Cameras) -> None:
    if not gaussians.means.is_cuda:
        raise ValueError(
            f"qgs/gsplat renders CUDA tensors, got Gaussians on {gaussians.means.device}; move "
            "them with .to('cuda') or choose `renderer: {type: qgs/auto}`"
        )
    if gaussians.means.dtype == torch.float64:
        raise ValueError(
            "qgs/gsplat renders float32, got float64 Gaussians; convert them with "
            ".to(torch.float32) or choose `renderer: {type: qgs/torch}`"
        )
    if cameras.intrinsics.requires_grad:
        raise ValueError(
            "gsplat has no gradient for intrinsics, but they require one; detach them or choose "
            "`renderer: {type: qgs/torch}`"
        )
    if find_spec("gsplat") is None:
        raise MissingExtraError(
            "the renderer qgs/gsplat needs gsplat, which is not installed: run "
            '`pip install "query-gaussians[gsplat]"`, or choose `renderer: {type: qgs/torch}`'
        )
