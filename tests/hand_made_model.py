"""A TokenGS of a few thousand parameters, cameras, and noise that they see."""

import pytest
import torch
from commands import ONE_LAYER
from walk import along_x, pinhole

import qgs
from qgs.types import Views

OVERRIDES = [
    "model={queries: {count: 12}, decoder: {depth: 3, layer_scale: 0.1}, head: "
    "{init_std: 0.3, scale_cap: 0.2}, supervision: {layers: [3]}, renderer: {type: qgs/torch}}"
]


@pytest.fixture
def model():
    return qgs.compose(ONE_LAYER, OVERRIDES).eval()


@pytest.fixture
def cameras():
    """Two cameras (1, 2) of 32x32, the identity and one to its right."""
    return pinhole(along_x([0.0, 0.3]), size=(32, 32))[None]


@pytest.fixture
def views(cameras):
    return Views(torch.rand(1, 2, 3, 32, 32), cameras)
