"""Inputs and results of the released losses."""

from pathlib import Path

import pytest
from safetensors.torch import load_file
from torch import Tensor


@pytest.fixture
def golden() -> dict[str, Tensor]:
    return load_file(Path(__file__).parents[1] / "golden" / "loss_a.safetensors")
