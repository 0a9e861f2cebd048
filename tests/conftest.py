"""Every test draws the same numbers on one thread; plugins for tests are installed in a folder."""

import gc

import pytest
import suite_watch
from installing import install

__all__ = ["install"]


def pytest_configure(config):
    """Have the whole suite, tests of plugins too, say what it costs."""
    config.pluginmanager.register(suite_watch)


def pytest_collection_finish():
    """Leave what was imported to itself: walking through it took a tenth of the time."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(100_000, 20, 20)


@pytest.fixture(autouse=True)
def _seeded_on_one_thread():
    """The models are so small that a second thread only waits."""
    import torch  # the controller of several processes needs none

    torch.set_num_threads(1)
    torch.manual_seed(0)


@pytest.fixture(autouse=True)
def few_samples_measured(monkeypatch):
    """A training measures the ranges of its views in .1 s, not in a second."""
    monkeypatch.setattr("qgs.data.stream.MEASURED", 48)
