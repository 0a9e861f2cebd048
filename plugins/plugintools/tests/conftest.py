"""Checks run on one thread; plugins for tests are installed in a folder."""

import pytest
import torch
from installing import install

__all__ = ["install"]


@pytest.fixture(autouse=True)
def _on_one_thread() -> None:
    torch.set_num_threads(1)
