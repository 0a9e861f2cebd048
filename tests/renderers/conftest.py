"""The renderers, each where it can run."""

from importlib.util import find_spec

import pytest
import torch

from qgs.contracts import RendererConfig
from qgs.renderers import CpuRenderer, GsplatRenderer, TorchRenderer

RENDERERS = {"torch": TorchRenderer, "cpu": CpuRenderer, "gsplat": GsplatRenderer}
HAS_GSPLAT = torch.cuda.is_available() and find_spec("gsplat") is not None
NEEDS_GSPLAT = pytest.mark.skipif(not HAS_GSPLAT, reason="needs a CUDA GPU and gsplat")


@pytest.fixture(params=["torch", "cpu", pytest.param("gsplat", marks=NEEDS_GSPLAT)])
def build(request):
    """`build(**options)`: the renderer under test, on tensors where the test makes them."""
    cls = RENDERERS[request.param]

    class Moved(cls):
        """Renders on the device it needs and brings the images back."""

        kind = request.param

        def forward(self, gaussians, cameras, background=None):
            device = "cuda" if cls is GsplatRenderer else "cpu"
            out = super().forward(gaussians.to(device), cameras.to(device), background)
            return out.to("cpu")

    return lambda **options: Moved(RendererConfig(**options))
