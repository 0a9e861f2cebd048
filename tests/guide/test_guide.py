"""The guide says what the code does: its recipes, code, references and tables."""

import re
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from types import ModuleType

import guide_reference
import pytest
import torch
import yaml
from guide_pages import blocks, text_of
from qgs_plugintools import Case, checks_for, run_check

from qgs.composer import RecipeError, resolve
from qgs.composer.registry import load_registry
from qgs.composer.slots import SLOTS
from qgs.contracts import ComponentConfig, ModelDims
from qgs.types import QueryState


def test_quick_start_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("mine.yaml").write_text(blocks("index.md", "yaml")["mine.yaml"])
    (code,) = blocks("index.md", "python").values()
    names: dict[str, object] = {}
    exec(code, names)
    assert names["means"].shape == (1, 32 * 8, 3)  # type: ignore[attr-defined]
    assert names["image"].shape == (1, 2, 3, 32, 48)  # type: ignore[attr-defined]


@pytest.fixture
def near(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """The component of the page of ideas, as a module that other processes can import too."""
    name = "component_of_the_guide"
    (tmp_path / f"{name}.py").write_text(blocks("ideas.md", "python")["near.py"])
    monkeypatch.syspath_prepend(tmp_path)
    yield import_module(name)
    del sys.modules[name]


def test_the_code_of_the_five_ideas_computes_its_formula_and_keeps_its_contract(
    near: ModuleType,
) -> None:
    centers = near.NearCenters(near.NearCenters.Config(distance=2.0), ModelDims(16, 2, 1))
    means = centers(torch.zeros(1, 8, 4, 3), QueryState(torch.zeros(1, 8, 16)))
    assert means.tolist() == [[[[0.0, 0.0, 2.0]] * 4] * 8]
    case = Case(near.NearCenters.Config())
    outcomes = [run_check(check, case) for check in checks_for(case, ["core"])]
    assert [outcome.message for outcome in outcomes if outcome.verdict == "failed"] == []
    code = blocks("ideas.md", "python")
    assert set(code) == {"near.py", "state.py"}
    exec(code["state.py"], {})


def test_the_five_ideas_count_and_name_all_slots() -> None:
    first = text_of("ideas.md").partition("A forward pass")[0]
    assert f"{len(SLOTS)} places" in first
    assert [slot for slot in SLOTS if slot not in first] == []
    without = [name for name, slot in SLOTS.items() if not (slot.default or slot.defaults)]
    assert f"Every slot but `{'`, `'.join(without)}` has a default" in text_of("ideas.md")


def test_recipes_of_the_five_ideas(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name, text in blocks("ideas.md", "yaml").items():
        Path(name).write_text(text)
    tree = resolve("recipe.yaml").tree
    layers = tree["model"]["decoder"]["layers"]
    assert layers["0"]["cross_attention"]["type"] == "qgs/content"
    assert tree["model"]["decoder"]["feed_forward"]["ratio"] == 2
    with pytest.raises(RecipeError, match=r"needs anchor\.raw_radius"):
        resolve("refused.yaml")


def _configs() -> dict[str, type[ComponentConfig]]:
    registry = load_registry(guide_reference.PLUGINS)
    components = {
        f"{slot} {name}": component.Config
        for slot in SLOTS
        for name, component in registry.components(slot).items()
    }
    return {**guide_reference.SECTIONS, **components}


@pytest.mark.parametrize("name", _configs())
def test_reference_explains_every_option(name: str) -> None:
    config = _configs()[name]
    assert not [name for name, field in config.model_fields.items() if not field.description]
    rows = guide_reference.option_table(config).splitlines()[2:]
    shown = {yaml_cell(row, 0): yaml_cell(row, 2) for row in rows}
    assert set(shown) == set(config.model_fields)
    for option, field in config.model_fields.items():
        if not field.is_required():
            default = field.get_default(call_default_factory=True)
            plain = config.model_construct(**{option: default}).model_dump(mode="json")[option]
            assert yaml.safe_load(shown[option]) == plain, option


def yaml_cell(row: str, index: int) -> str:
    return re.split(r"(?<!\\)\|", row)[1 + index].strip().strip("`")
