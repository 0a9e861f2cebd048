"""A TokenGS of a few thousand parameters, a hand-made scene, cameras that look at it."""

import pytest
import torch
from commands import MODEL
from walk import along_x, pinhole

import qgs
from qgs.types import Gaussians, Views

OPTIONS = [
    "queries.count=12",
    "decoder={depth: 3, layer_scale: 0.1}",
    "head={init_std: 0.3, scale_cap: 0.2}",
    "supervision.layers=[3]",
    "renderer.type=qgs/torch",
]


@pytest.fixture
def model():
    overrides = [f"model.{option}" for option in OPTIONS]
    return qgs.compose({"recipe": 1, "model": MODEL}, overrides).eval()


@pytest.fixture
def cameras():
    """Two cameras (1, 2) of 32x32, the identity and one to its right."""
    return pinhole(along_x([0.0, 0.3]), (32.0, 32.0, 16.0, 16.0), (32, 32))[None]


@pytest.fixture
def views(cameras):
    return Views(torch.rand(1, 2, 3, 32, 32, generator=torch.Generator().manual_seed(1)), cameras)


@pytest.fixture
def gaussians():
    """As many as the model makes, spread over what the cameras see."""
    generator = torch.Generator().manual_seed(2)
    xy, z, colours = torch.rand(1, 48, 6, generator=generator).split([2, 1, 3], -1)
    z = z + 1
    quats = torch.tensor([1.0, 0, 0, 0]).expand(1, 48, 4)
    means = torch.cat([(xy - 0.5) * z, z], -1)
    opacities = torch.full((1, 48), 0.8)
    return Gaussians(means, torch.full((1, 48, 3), 0.05), quats, opacities, colours)
