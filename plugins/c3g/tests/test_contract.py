"""Every component keeps its contract, as `qgs check-plugin c3g` says too."""

import json
from dataclasses import replace
from pathlib import Path

from qgs_plugintools import cases_of, parametrize_with_checks
from qgs_plugintools.plugins import without_case

from qgs.composer.registry import load_plugin

SNAPSHOT = json.loads((Path(__file__).parent / "state_dicts.json").read_text())
"""Label of a case -> name -> shape in its state dict, so that saved weights stay loadable."""

PLUGIN = load_plugin("c3g")
CASES = [replace(case, state_dict=SNAPSHOT.get(case.label)) for case in cases_of(PLUGIN)]


def test_state_dicts_of_all_cases_are_pinned_and_no_others() -> None:
    with_weights = {case.label for case in CASES if case.build().state_dict()}
    assert SNAPSHOT.keys() == with_weights


def test_what_needs_weights_of_its_own_is_tested_elsewhere() -> None:
    assert {c.name for c in without_case(PLUGIN)} == {"vggt_features"}


@parametrize_with_checks(CASES, tiers=["core"])
def test_contract(check) -> None:
    check()
