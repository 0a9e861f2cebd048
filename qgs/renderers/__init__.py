"""The built-in renderers, and `qgs/auto`, which chooses one of them by device."""

from torch import Tensor

from qgs.contracts import Component, Renderer
from qgs.renderers.cpu import CpuRenderer
from qgs.renderers.gsplat import GsplatRenderer
from qgs.renderers.reference import TorchRenderer
from qgs.types import Cameras, Gaussians, Rendering

__all__ = ["COMPONENTS", "AutoRenderer", "CpuRenderer", "GsplatRenderer", "TorchRenderer"]


class AutoRenderer(Renderer):
    """Renderer that uses `qgs/gsplat` for Gaussians on CUDA and `qgs/cpu` for all others."""

    name = "auto"
    camera_gradients = GsplatRenderer.camera_gradients
    # Refused on the CPU too, so that results do not depend on the device.
    problems = GsplatRenderer.problems  # type: ignore[assignment]

    def draw(
        self, gaussians: Gaussians, cameras: Cameras, channels: Tensor, backdrop: Tensor
    ) -> Rendering:
        """Render every scene from each of its cameras; raise RuntimeError if gsplat is missing."""
        kind = GsplatRenderer if gaussians.means.is_cuda else CpuRenderer
        # Created in each call, because options may follow a schedule.
        return kind(self.config).draw(gaussians, cameras, channels, backdrop)


COMPONENTS: tuple[type[Component], ...] = (AutoRenderer, CpuRenderer, GsplatRenderer, TorchRenderer)
