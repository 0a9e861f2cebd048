"""Every test of a plugin draws the same random numbers, whichever ran before it."""

import pytest


@pytest.fixture(autouse=True)
def _seed() -> None:
    import torch  # the controller of several processes needs none

    torch.manual_seed(0)


@pytest.fixture(autouse=True)
def few_samples_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    """A training measures the ranges of its views in .1 s, not in a second."""
    monkeypatch.setattr("qgs.data.stream.MEASURED", 48)
