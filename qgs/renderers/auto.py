"""`qgs/auto`: gsplat for tensors on CUDA, `qgs/cpu` otherwise."""

from __future__ import annotations

from collections.abc import Iterable

from torch import Tensor

from qgs.contracts import ComponentConfig, Problem, RecipeContext, Renderer
from qgs.renderers.cpu import CpuRenderer
from qgs.renderers.gsplat import GsplatRenderer
from qgs.types import Cameras, Gaussians, Rendering


class AutoRenderer(Renderer):
    """Chooses by where the Gaussians are, each time, and never by what can be imported."""

    name = "auto"
    camera_gradients = GsplatRenderer.camera_gradients

    @classmethod
    def problems(cls, config: ComponentConfig, context: RecipeContext) -> Iterable[Problem]:
        """What gsplat cannot do is refused on the CPU too, so that a recipe means one thing."""
        return GsplatRenderer.problems(config, context)

    def forward(
        self, gaussians: Gaussians, cameras: Cameras, background: Tensor | None = None
    ) -> Rendering:
        """See `Renderer`. Raises RuntimeError when the package it needs is not installed."""
        renderer = GsplatRenderer if gaussians.means.is_cuda else CpuRenderer
        return renderer(self.config)(gaussians, cameras, background)
