"""The built-in renderers, and `auto`, which chooses one by device."""

from collections.abc import Iterable

from torch import Tensor

from qgs.contracts import Component, ComponentConfig, Problem, RecipeContext, Renderer
from qgs.renderers.cpu import CpuRenderer
from qgs.renderers.gsplat import GsplatRenderer
from qgs.renderers.reference import TorchRenderer
from qgs.types import Cameras, Gaussians, Rendering

__all__ = ["COMPONENTS", "AutoRenderer", "CpuRenderer", "GsplatRenderer", "TorchRenderer"]


class AutoRenderer(Renderer):
    """Renderer that uses gsplat for Gaussians on CUDA, and `qgs/cpu` for all others."""

    name = "auto"
    camera_gradients = GsplatRenderer.camera_gradients

    @classmethod
    def problems(cls, config: ComponentConfig, context: RecipeContext) -> Iterable[Problem]:
        """Return problems of options that gsplat lacks, also on the CPU, for equal results."""
        return GsplatRenderer.problems(config, context)

    def forward(
        self, gaussians: Gaussians, cameras: Cameras, background: Tensor | None = None
    ) -> Rendering:
        """See `Renderer`. Raises RuntimeError if the package that it needs is not installed."""
        kind = GsplatRenderer if gaussians.means.is_cuda else CpuRenderer
        # Created in each call, because options may follow a schedule.
        return kind(self.config)(gaussians, cameras, background)


COMPONENTS: tuple[type[Component], ...] = (AutoRenderer, CpuRenderer, GsplatRenderer, TorchRenderer)
