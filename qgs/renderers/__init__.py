"""The renderers, and the one that chooses between two by device; one contract, `Renderer`."""

from collections.abc import Iterable

from torch import Tensor

from qgs.contracts import Component, ComponentConfig, Problem, RecipeContext, Renderer
from qgs.renderers.cpu import CpuRenderer
from qgs.renderers.gsplat import GsplatRenderer
from qgs.renderers.reference import TorchRenderer
from qgs.types import Cameras, Gaussians, Rendering

__all__ = ["COMPONENTS", "AutoRenderer", "CpuRenderer", "GsplatRenderer", "TorchRenderer"]


class AutoRenderer(Renderer):
    """gsplat for Gaussians on CUDA, `qgs/cpu` for others, whatever is installed."""

    name = "auto"
    camera_gradients = GsplatRenderer.camera_gradients

    @classmethod
    def problems(cls, config: ComponentConfig, context: RecipeContext) -> Iterable[Problem]:
        """Options that gsplat lacks: refused on the CPU too, so that a recipe means one thing."""
        return GsplatRenderer.problems(config, context)

    def forward(
        self, gaussians: Gaussians, cameras: Cameras, background: Tensor | None = None
    ) -> Rendering:
        """See `Renderer`. Raises RuntimeError when the package it needs is not installed."""
        kind = GsplatRenderer if gaussians.means.is_cuda else CpuRenderer
        # Made anew, since options may follow a schedule.
        return kind(self.config)(gaussians, cameras, background)


COMPONENTS: tuple[type[Component], ...] = (AutoRenderer, CpuRenderer, GsplatRenderer, TorchRenderer)
