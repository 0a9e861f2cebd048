"""Inputs of the tests: cameras side by side, noise pictures, states of two streams."""

import torch
from qgs_globalsplat.streams import TEXTURE

from qgs.contracts import ModelDims
from qgs.types import Cameras, QueryState, Views

DIMS = ModelDims(width=16, heads=2, depth=2)


def cameras(count: int = 2, size: tuple[int, int] = (12, 16), scenes: int = 2) -> Cameras:
    c2w = torch.eye(4).repeat(scenes, count, 1, 1)
    c2w[..., 0, 3] = 0.3 * torch.arange(count) + 0.1 * torch.arange(scenes)[:, None]
    c2w[..., 1, 3] = 0.05 * torch.arange(count)
    lens = torch.tensor([20.0, 18.0, 7.0, 6.5]).expand(scenes, count, 4).clone()
    return Cameras(c2w, lens, size)


def views(count: int = 2, size: tuple[int, int] = (12, 16)) -> Views:
    images = torch.rand(2, count, 3, *size, generator=torch.Generator().manual_seed(0))
    return Views(images, cameras(count, size))


def state(count: int = 5) -> QueryState:
    draw = torch.Generator().manual_seed(1)
    geometry, texture = (torch.randn(2, count, DIMS.width, generator=draw) for _ in range(2))
    return QueryState(geometry, {TEXTURE: texture})


def lively(module: torch.nn.Module) -> torch.nn.Module:
    """`module` with noise on all parameters, so that nothing hides behind an initial 0."""
    torch.manual_seed(2)
    with torch.no_grad():
        for parameter in module.parameters():
            parameter += 0.3 * torch.randn_like(parameter)
    return module.double()
