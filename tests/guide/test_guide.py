"""The guide says what the code does: its recipes, code, references and tables."""

import re
from importlib import import_module
from pathlib import Path

import guide
import pytest
import torch
import yaml
from guide_pages import blocks
from qgs_dev import Case, CaseRun

from qgs.contracts import ModelDims
from qgs.recipe import RecipeError, resolve
from qgs.recipe.slots import SLOTS
from qgs.types import QueryState

pytestmark = pytest.mark.usefixtures("here")


def test_quick_start_runs():
    Path("mine.yaml").write_text(blocks("index.md", "yaml")["mine.yaml"])
    (code,) = blocks("index.md", "python").values()
    names = {}
    exec(code, names)
    assert names["means"].shape == (1, 32 * 8, 3)
    assert names["image"].shape == (1, 2, 3, 32, 48)


def test_the_code_of_the_five_ideas_computes_its_formula_and_keeps_its_contract(
    tmp_path, monkeypatch
):
    # a module that other processes can import too
    Path("component_of_the_guide.py").write_text(blocks("ideas.md", "python")["ahead.py"])
    monkeypatch.syspath_prepend(tmp_path)
    near = import_module("component_of_the_guide").AheadCenters
    centers = near(near.Config(distance=2.0), ModelDims(16, 2, 1))
    means = centers(torch.zeros(1, 8, 4, 3), QueryState(torch.zeros(1, 8, 16)))
    assert means.tolist() == [[[[0.0, 0.0, 2.0]] * 4] * 8]
    CaseRun(Case(near.Config())).check(["core"])


def test_recipes_of_the_five_ideas():
    for name, text in blocks("ideas.md", "yaml").items():
        Path(name).write_text(text)
    decoder = resolve("recipe.yaml").tree["model"]["decoder"]
    assert decoder["layers"]["0"]["cross_attention"]["type"] == "qgs/content"
    assert decoder["feed_forward"]["ratio"] == 2
    with pytest.raises(RecipeError, match=r"needs anchor\.raw_radius"):
        resolve("refused.yaml")


def test_the_reference_explains_every_option():
    configs = [*guide.SECTIONS.values()]
    configs += [c.Config for slot in SLOTS for c in guide.REGISTRY.components(slot).values()]
    for config in configs:
        rows = guide.option_table(config).splitlines()[2:]
        cells = [[x.strip().strip("`") for x in re.split(r"(?<!\\)\|", row)] for row in rows]
        shown = {option: default for _, option, _, default, *_ in cells}
        assert {o for o in shown if "." not in o} == config.model_fields.keys()
        for option, field in config.model_fields.items():
            assert field.description, option
            if not field.is_required():
                default = field.get_default(call_default_factory=True)
                plain = config.model_construct(**{option: default}).model_dump(mode="json")[option]
                assert yaml.safe_load(shown[option]) == plain, option
