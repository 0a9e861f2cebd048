"""Every test draws the same numbers on one thread; plugins for tests are installed in a folder."""

import gc

import numpy as np
import pytest

pytest_plugins = ["installing", "suite_watch"]
"""The fixture `install`; what the whole suite costs, tests of plugins too."""


def pytest_collection_finish():
    """Leave what was imported to itself: walking through it took a tenth of the time."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(100_000, 20, 20)


@pytest.fixture(autouse=True)
def _seeded_on_one_thread():
    """Use one thread: the models are so small that a second one only waits.

    What is told once is told again in each test.
    """
    import torch  # the controller of several processes needs none

    from qgs.wording import warn_once

    torch.set_num_threads(1)
    torch.manual_seed(0)
    warn_once.cache_clear()


@pytest.fixture(autouse=True, scope="session")
def few_samples_measured_and_short_orbits():
    """Measure the ranges of a training's views in .02 s, not in a second.

    Orbits have two frames of 16 pixels.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("qgs.data.stream.MEASURED", 8)
        patch.setattr("qgs.reconstruction.saving.ORBIT_FRAMES", 2)
        patch.setattr("qgs.reconstruction.saving.ORBIT_SIDE", 16)
        yield


@pytest.fixture
def here(tmp_path, monkeypatch):
    """Make an empty folder the working directory."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def small_pictures(monkeypatch):
    """Overview and orbit are most of the work of saving; one test looks at a real overview."""
    picture = np.zeros((4, 4, 3), np.uint8)
    monkeypatch.setattr("qgs.reconstruction.saving.overview", lambda result: picture)
