"""A plugin whose components depend on each other, and recipes in the working directory."""

from collections.abc import Callable
from pathlib import Path
from textwrap import dedent

import pytest

SPATIAL = """
from typing import Literal
from qgs.contracts import (
    CrossAttention, ComponentConfig, FieldSpec, LearnedQueries, Plugin, Refinement, SceneSource)
from qgs.types import QueryState

PLACE = {"place.center": FieldSpec((3,), frame="world")}
RADIUS = {"place.radius": FieldSpec((1,), frame="world")}

class Placed(LearnedQueries):
    name = "placed"
    class Config(ComponentConfig):
        count: int = 4
        radius: bool = True
    @classmethod
    def fields_written(cls, config):
        return PLACE | (RADIUS if config.radius else {})
    @property
    def count(self):
        return self.config.count
    def start(self, batch_size):
        raise NotImplementedError

class Near(CrossAttention):
    name = "near"
    class Config(ComponentConfig):
        bandwidth: Literal["radius", "fixed"] = "radius"
        sigma: float = 0.1
    @classmethod
    def fields_read(cls, config):
        return PLACE | (RADIUS if config.bandwidth == "radius" else {})
    def forward(self, state, memory):
        raise NotImplementedError

class Measure(Refinement):
    name = "measure"
    @classmethod
    def fields_written(cls, config):
        return RADIUS
    def forward(self, state):
        return state

class Local(Refinement):
    name = "local"
    @classmethod
    def fields_read(cls, config):
        return {"place.center": FieldSpec((3,), frame="camera")}
    def forward(self, state):
        return state

class Scenes(SceneSource):
    name = "scenes"
    def scenes(self, split):
        return []

plugin = Plugin("spatial", 1, (Placed, Near, Measure, Local, Scenes))
"""


@pytest.fixture
def spatial(install: Callable[..., None]) -> None:
    """A sound plugin whose components depend on each other."""
    install("qgs-spatial", "spatial", SPATIAL)


@pytest.fixture
def write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Path]:
    """Write recipes into the working directory: write(text) or write(text, name)."""
    monkeypatch.chdir(tmp_path)

    def write(text: str, name: str = "recipe.yaml") -> Path:
        Path(name).write_text(dedent(text).lstrip("\n"))
        return Path(name)

    return write
