"""Recipes that train in a blink, and a plugin with an objective of two passes."""

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from qgs.composer import Recipe, resolve

RECIPES = Path(__file__).parents[2] / "recipes" / "tiny"

SMALL = (
    "model.width=32",
    "model.heads=2",
    "model.queries.count=24",
    "model.head.gaussians_per_query=4",
    "data.image_size=[16, 16]",
    "views.targets=2",
    "evaluation.scenes=2",
    "training.steps=4",
    "training.seconds=null",
    "optimizer.warmup=2",
)


@pytest.fixture(scope="session")
def tiny() -> Callable[..., Recipe]:
    """`tiny("tokengs", "a.b=c")`: a recipe of recipes/tiny, smaller yet, with overrides."""

    def make(name: str, *overrides: str) -> Recipe:
        return resolve(RECIPES / f"{name}.yaml", [*SMALL, *overrides])

    return make


@pytest.fixture
def two(install: Callable[..., None], monkeypatch: pytest.MonkeyPatch) -> None:
    """The plugin of two_passes.py, installed for this process and for those that it starts."""
    install("qgs-two", "two", Path(__file__).with_name("two_passes.py").read_text())
    monkeypatch.setenv("PYTHONPATH", sys.path[0])
