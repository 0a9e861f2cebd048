"""Scenes with well separated depths, and gradients of everything a renderer differentiates."""

from functools import partial

import torch
from odd_views import odd_views
from qgs_dev.vocabulary import scalar, tracked

from qgs.containers import named_tensors
from qgs.types import Gaussians


def make_scene(
    batch=1,
    views=1,
    count=40,
    size=(24, 40),
    scale=0.08,
    harmonics=0,
    features=0,
    dtype=torch.float32,
):
    """Gaussians in front of turned cameras, many beyond the borders; quaternions of any length.

    scale: of all, or of each scene (B, 1, 1). harmonics, features: how many coefficients and
    further channels the Gaussians have.
    """
    generator = torch.Generator().manual_seed(0)
    rand = partial(torch.rand, generator=generator, dtype=torch.float64)
    randn = partial(torch.randn, generator=generator, dtype=torch.float64)
    depth = torch.linspace(1.5, 4.0, count)[torch.randperm(count, generator=generator)]
    depth = depth.expand(batch, count)[..., None]
    gaussians = Gaussians(
        means=torch.cat([rand(batch, count, 2) * 2.4 - 1.2, depth], -1),
        scales=scale * (0.7 * randn(batch, count, 3)).exp(),
        quats=randn(batch, count, 4),
        opacities=0.05 + 0.9 * rand(batch, count),
        colors=rand(batch, count, 3),
        sh=0.1 * randn(batch, count, harmonics, 3) if harmonics else None,
        features=randn(batch, count, features) if features else None,
    )
    return gaussians.to(dtype), odd_views(views, *size, batch).cameras.to(dtype)


def differentiate(renderer, gaussians, cameras):
    """The rendering, and gradients by name of a fixed random projection of all its images."""
    gaussians, cameras = tracked((gaussians, cameras))
    given = dict(named_tensors(gaussians)) | dict(named_tensors(cameras))
    if renderer.name == "gsplat":
        given.pop("intrinsics").requires_grad_(False)
    rendering = renderer(gaussians, cameras)
    gradients = torch.autograd.grad(scalar(rendering), [*given.values()])
    return rendering, dict(zip(given, gradients, strict=True))
