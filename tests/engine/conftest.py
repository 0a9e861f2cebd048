"""Recipes that train in a blink, and a plugin with an objective of two passes."""

import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from training_runs import Tiny, tiny_recipe


@pytest.fixture(scope="session")
def tiny() -> Tiny:
    """See `tiny_recipe`."""
    return tiny_recipe


@pytest.fixture
def two(install: Callable[..., None], monkeypatch: pytest.MonkeyPatch) -> None:
    """The plugin of two_passes.py, installed for this process and for those that it starts."""
    install("qgs-two", "two", Path(__file__).with_name("two_passes.py").read_text())
    monkeypatch.setenv("PYTHONPATH", sys.path[0])
