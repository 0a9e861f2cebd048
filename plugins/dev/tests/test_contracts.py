"""Every component of this repository keeps its contract, and its weights keep their names."""

import json
from dataclasses import replace
from importlib.metadata import entry_points
from pathlib import Path

import pytest
from qgs_dev import runs_of
from qgs_dev.running import without_case
from tables import read_json

from qgs.checkpoint.tensors import shapes_of
from qgs.recipe.registry import load_plugin

PINNED = read_json(Path(__file__).parent / "state_dicts.json")
"""Plugin -> label of a case -> name -> shape of a weight, so that saved weights stay loadable."""

WITHOUT_CASE = {"vggt_features"}
"""Components that need weights of their own, which the tests of their plugin make."""


RUNS = []
for plugin, pinned in PINNED.items():
    for run in runs_of(plugin):
        run.case = replace(run.case, state_dict=pinned.get(run.case.label))
        RUNS.append(run)


MARKED = [pytest.param(run, marks=[pytest.mark.slow] * (run.case.slot == "data")) for run in RUNS]


@pytest.mark.parametrize("run", MARKED, ids=str)
def test_contract(run):
    run.check(["core"])


@pytest.mark.slow
@pytest.mark.parametrize("run", [run for run in RUNS if not run.variant], ids=str)
def test_extended_contract(run):
    run.check(["construction", "extended"])


def test_every_component_is_checked_and_its_weights_are_pinned():
    unchecked = set()
    for plugin, pinned in PINNED.items():
        runs = {run.case.label: run for run in runs_of(plugin) if run.case.has_parameters}
        new = [run.case for label, run in runs.items() if not run.variant and label not in pinned]
        missing = {case.label: shapes_of(case.build().state_dict()) for case in new}
        assert not missing, f"add to {plugin} in state_dicts.json: {json.dumps(missing)}"
        assert pinned.keys() <= runs.keys(), plugin
        unchecked |= {component.name for component in without_case(load_plugin(plugin))}
    assert unchecked == WITHOUT_CASE


def test_every_plugin_of_this_repository_is_checked():
    entries = entry_points(group="qgs.plugins")
    ours = {x.name for x in entries if x.dist and x.dist.name.startswith("query-gaussians-")}
    assert PINNED.keys() == {"qgs", *ours}
