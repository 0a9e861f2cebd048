"""`qgs new-plugin`: what it writes, and what it refuses."""

import math
import subprocess
import sys
import tomllib
from functools import cache
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
import torch
from commands import done, run_qgs
from qgs_dev.new_command import check_name, rendered
from small_parts import made
from tables import names_in

from qgs.recipe.errors import Problems
from qgs.recipe.yaml_text import load_mapping
from qgs.types import ImageMemory, QueryState

LISTED = cache(packages_distributions)
NAMES = """
a wide far-sighted far_sighted view2d
no on yes off n inf nan
"""
"""The last are values for other readers of YAML."""
WRITTEN = """
.gitignore README.md pyproject.toml recipe.yaml src/qgs_far_sighted/__init__.py
src/qgs_far_sighted/abstaining.py src/qgs_far_sighted/py.typed tests/test_contract.py
"""


@pytest.fixture(autouse=True)
def _in_an_empty_folder(here, monkeypatch):
    monkeypatch.setattr("qgs_dev.new_command.packages_distributions", LISTED)


def test_it_writes_a_complete_distribution(tmp_path):
    done("new-plugin far-sighted")
    folder = tmp_path / "qgs-far-sighted"
    files = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
    assert files == {*WRITTEN.split()}
    project = tomllib.loads((folder / "pyproject.toml").read_text())["project"]
    assert project["name"] == "qgs-far-sighted"
    assert project["entry-points"]["qgs.plugins"] == {"far-sighted": "qgs_far_sighted:plugin"}
    assert names_in(tmp_path) == {"qgs-far-sighted"}, "nothing is left over"


def test_what_it_writes_needs_no_tidying(tmp_path):
    run_qgs("new-plugin tidy")
    for command in (["check", "--select", "E,F,W,I,UP,B"], ["format", "--check"]):
        ruff = [sys.executable, "-m", "ruff", *command, "--no-cache", "qgs-tidy"]
        checked = subprocess.run(ruff, cwd=tmp_path, capture_output=True, text=True)
        assert checked.returncode == 0, checked.stdout


def test_names_that_are_taken_as_they_are():
    for name in NAMES.split():
        check_name(name)
        text = dict(rendered(name))[Path("recipe.yaml")]
        assert load_mapping(text, "recipe.yaml", Problems())["plugins"][-1] == name


def test_names_that_are_refused(tmp_path):
    names = ("Far Sighted", "../escape", "", "locus", "class", "torch")
    errors = {name: run_qgs("new-plugin --", name).exception for name in names}
    assert not [name for name, error in errors.items() if not isinstance(error, ValueError)]
    assert not names_in(tmp_path)


def test_nothing_is_overwritten(tmp_path):
    (tmp_path / "mine").mkdir()
    assert isinstance(run_qgs("new-plugin wide --out mine").exception, FileExistsError)
    assert list(tmp_path.rglob("*")) == [tmp_path / "mine"]


def test_its_component_computes_its_formula():
    source = dict(rendered("mine"))[Path("src/qgs_mine/abstaining.py")]
    names = {}
    exec(source, names)
    attention = names["AbstainingAttention"]
    state = QueryState(torch.randn(2, 3, 16))
    keys, values = torch.randn(2, 2, 2, 6, 8)
    memory = ImageMemory(torch.randn(2, 6, 16), keys, values, torch.randn(2, 6, 6), (1, 2, 3))
    for sink in (-0.5, 1.5):
        module = made(attention, sink_init=sink)
        logits = module.core.project(state.features) @ keys.mT / 8**0.5
        read = logits.exp() @ values / (math.exp(sink) + logits.exp().sum(-1, keepdim=True))
        expected = module.core.out_proj(read.transpose(1, 2).flatten(2))
        torch.testing.assert_close(module(state, memory), expected)
