"""Plugins for tests: fake distributions in a folder on sys.path."""

import json
import sys
from collections.abc import Callable
from pathlib import Path
from textwrap import dedent

import pytest

SPATIAL = """
from typing import Literal
from qgs.contracts import (
    CrossAttention, ComponentConfig, FieldSpec, Plugin, Queries, Refinement, SceneSource)
from qgs.types import QueryState

PLACE = {"place.center": FieldSpec((3,), frame="world")}
RADIUS = {"place.radius": FieldSpec((1,), frame="world")}

class Placed(Queries):
    name = "placed"
    class Config(ComponentConfig):
        count: int = 4
        radius: bool = True
    @classmethod
    def provides(cls, config):
        return PLACE | (RADIUS if config.radius else {})
    @property
    def count(self):
        return self.config.count
    def forward(self, batch_size):
        raise NotImplementedError

class Near(CrossAttention):
    name = "near"
    class Config(ComponentConfig):
        bandwidth: Literal["radius", "fixed"] = "radius"
        sigma: float = 0.1
    @classmethod
    def requires(cls, config):
        return PLACE | (RADIUS if config.bandwidth == "radius" else {})
    def forward(self, state, memory):
        raise NotImplementedError

class Measure(Refinement):
    name = "measure"
    @classmethod
    def provides(cls, config):
        return RADIUS
    def forward(self, state):
        return state

class Local(Refinement):
    name = "local"
    @classmethod
    def requires(cls, config):
        return {"place.center": FieldSpec((3,), frame="camera")}
    def forward(self, state):
        return state

class Scenes(SceneSource):
    name = "scenes"
    def scenes(self, split):
        return []

plugin = Plugin("spatial", 1, (Placed, Near, Measure, Local, Scenes))
"""

Install = Callable[..., None]


@pytest.fixture
def install(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Install:
    """Make a distribution importable: install(distribution, plugin name, module source).

    editable: as `pip install -e` leaves it.
    """

    def install(
        distribution: str, plugin: str, source: str, version: str = "1.2", editable: bool = False
    ) -> None:
        folder = tmp_path_factory.mktemp("site")
        module = f"_test_{distribution.replace('-', '_')}"
        (folder / f"{module}.py").write_text(dedent(source))
        info = folder / f"{distribution.replace('-', '_')}-{version}.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(
            f"Metadata-Version: 2.1\nName: {distribution}\nVersion: {version}\n"
        )
        (info / "entry_points.txt").write_text(f"[qgs.plugins]\n{plugin} = {module}:plugin\n")
        if editable:
            record = {"url": folder.as_uri(), "dir_info": {"editable": True}}
            (info / "direct_url.json").write_text(json.dumps(record))
        monkeypatch.syspath_prepend(folder)
        monkeypatch.delitem(sys.modules, module, raising=False)

    return install


@pytest.fixture
def spatial(install: Install) -> None:
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
