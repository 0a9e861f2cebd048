"""Checks run on one thread; plugins for tests are installed in a folder."""

import pytest
from installing import install

__all__ = ["install"]


@pytest.fixture(autouse=True)
def _on_one_thread() -> None:
    import torch  # the controller of several processes needs none

    torch.set_num_threads(1)
