"""The renderers, each where it can run."""

from importlib.util import find_spec

import pytest
import torch

from qgs.contracts import RendererConfig
from qgs.renderers import CpuRenderer, GsplatRenderer, TorchRenderer

HAS_GSPLAT = torch.cuda.is_available() and find_spec("gsplat")
NEEDS_GSPLAT = pytest.mark.skipif(not HAS_GSPLAT, reason="needs a CUDA GPU and gsplat")


@pytest.fixture(
    params=[TorchRenderer, CpuRenderer, pytest.param(GsplatRenderer, marks=NEEDS_GSPLAT)]
)
def build(request):
    """`build(**options)`: the renderer under test, on tensors where the test makes them."""

    class Moved(request.param):
        """Renders on the device it needs and brings the images back."""

        def forward(self, gaussians, cameras, background=None):
            device = "cuda" if self.name == "gsplat" else "cpu"
            out = super().forward(gaussians.to(device), cameras.to(device), background)
            return out.to("cpu")

    return lambda **options: Moved(RendererConfig(**options))
