"""The renderers: one contract, `qgs.contracts.Renderer`, and one set of contract tests."""

from qgs.contracts import Component
from qgs.renderers.auto import AutoRenderer
from qgs.renderers.cpu import CpuRenderer
from qgs.renderers.gsplat import GsplatRenderer
from qgs.renderers.reference import TorchRenderer

COMPONENTS: tuple[type[Component], ...] = (AutoRenderer, CpuRenderer, GsplatRenderer, TorchRenderer)

__all__ = ["COMPONENTS", "AutoRenderer", "CpuRenderer", "GsplatRenderer", "TorchRenderer"]
