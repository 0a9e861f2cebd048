"""Scenes with well separated depths, and gradients of everything a renderer differentiates."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from importlib.util import find_spec

import pytest
import torch
from torch import Tensor

from qgs.contracts import Renderer, RendererConfig
from qgs.geometry.transforms import quat_to_matrix
from qgs.renderers import CpuRenderer, GsplatRenderer, TorchRenderer
from qgs.types import Cameras, Gaussians, Rendering, named_tensors

RENDERERS = {"torch": TorchRenderer, "cpu": CpuRenderer, "gsplat": GsplatRenderer}
HAS_GSPLAT = torch.cuda.is_available() and find_spec("gsplat") is not None


@pytest.fixture(
    params=[
        "torch",
        "cpu",
        pytest.param(
            "gsplat",
            marks=pytest.mark.skipif(not HAS_GSPLAT, reason="needs a CUDA GPU and gsplat"),
        ),
    ]
)
def build(request: pytest.FixtureRequest) -> Callable[..., Renderer]:
    """`build(**options)`: the renderer under test, on tensors where the test makes them."""
    cls = RENDERERS[request.param]

    class Moved(cls):
        """Renders on the device it needs and brings the images back."""

        def forward(self, gaussians, cameras, background=None):
            device = "cuda" if cls is GsplatRenderer else "cpu"
            out = super().forward(gaussians.to(device), cameras.to(device), background)
            return out.to("cpu")

    def make(**options: object) -> Renderer:
        renderer = Moved(RendererConfig(**options))
        renderer.kind = request.param
        return renderer

    return make


@pytest.fixture
def make_scene() -> Callable[..., tuple[Gaussians, Cameras]]:
    """`make_scene(batch, views, count, size)`: float32 Gaussians in front of turned cameras.

    harmonics, features: how many coefficients and further channels they have.
    """

    def make(
        batch: int = 1,
        views: int = 1,
        count: int = 40,
        size: tuple[int, int] = (24, 40),
        scale: float = 0.08,
        seed: int = 0,
        harmonics: int = 0,
        features: int = 0,
    ) -> tuple[Gaussians, Cameras]:
        generator = torch.Generator().manual_seed(seed)
        rand = partial(torch.rand, generator=generator, dtype=torch.float64)
        randn = partial(torch.randn, generator=generator, dtype=torch.float64)
        depth = torch.linspace(1.5, 4.0, count, dtype=torch.float64)
        depth = torch.stack([depth[torch.randperm(count, generator=generator)]] * batch)
        means = torch.cat([(rand(batch, count, 2) * 2 - 1) * 1.2, depth[..., None]], -1)
        gaussians = Gaussians(
            means=means,
            scales=scale * (0.7 * randn(batch, count, 3)).exp(),
            quats=torch.nn.functional.normalize(randn(batch, count, 4), dim=-1),
            opacities=0.05 + 0.9 * rand(batch, count),
            colors=rand(batch, count, 3),
        )
        turn = torch.cat([torch.ones(batch, views, 1), 0.03 * randn(batch, views, 3)], -1)
        c2w = torch.eye(4, dtype=torch.float64).repeat(batch, views, 1, 1)
        c2w[..., :3, :3] = quat_to_matrix(torch.nn.functional.normalize(turn, dim=-1))
        c2w[..., :3, 3] = 0.1 * randn(batch, views, 3)
        height, width = size
        focal = max(size) * (0.9 + 0.2 * rand(batch, views, 2))
        centre = torch.tensor([width / 2, height / 2]) + 0.5 * randn(batch, views, 2)
        cameras = Cameras(c2w, torch.cat([focal, centre], -1), size)
        if harmonics:
            gaussians = replace(gaussians, sh=0.1 * randn(batch, count, harmonics, 3))
        if features:
            gaussians = replace(gaussians, features=randn(batch, count, features))
        return gaussians.to(torch.float32), cameras.to(torch.float32)

    return make


Gradients = dict[str, Tensor]


@pytest.fixture
def differentiate() -> Callable[..., tuple[Rendering, Gradients]]:
    """`differentiate(renderer, gaussians, cameras)`: rendering and gradients by name.

    The loss is a fixed random projection of rgb, alpha and depth.
    """

    def run(
        renderer: Renderer, gaussians: Gaussians, cameras: Cameras
    ) -> tuple[Rendering, Gradients]:
        leaves = dict(named_tensors(gaussians))
        leaves |= {"c2w": cameras.c2w, "intrinsics": cameras.intrinsics}
        leaves = {name: value.detach().clone().requires_grad_() for name, value in leaves.items()}
        if getattr(renderer, "kind", "") == "gsplat":
            leaves["intrinsics"].requires_grad_(False)
        lenses = Cameras(leaves["c2w"], leaves["intrinsics"], cameras.size)
        scene = Gaussians(**{name: leaves[name] for name, _ in named_tensors(gaussians)})
        rendering = renderer(scene, lenses)
        generator = torch.Generator().manual_seed(1)
        loss = torch.zeros((), dtype=rendering.rgb.dtype)
        for _, image in named_tensors(rendering):
            weights = torch.rand(image.shape, generator=generator, dtype=torch.float64)
            loss = loss + (image * weights.to(image)).sum()
        names = [name for name, leaf in leaves.items() if leaf.requires_grad]
        grads = torch.autograd.grad(loss, [leaves[name] for name in names])
        return rendering.to(dtype=rendering.rgb.dtype), dict(zip(names, grads, strict=True))

    return run
