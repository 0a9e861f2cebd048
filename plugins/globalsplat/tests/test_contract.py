"""Every component keeps its contract, as `qgs check-plugin globalsplat` says too."""

import json
from dataclasses import replace
from pathlib import Path

from qgs_plugintools import cases_of, parametrize_with_checks

from qgs.composer.registry import load_plugin

SNAPSHOT = json.loads((Path(__file__).parent / "state_dicts.json").read_text())
"""Label of a case -> name -> shape in its state dict, so that saved weights stay loadable."""

INSTALLED = load_plugin("globalsplat")
CASES = [replace(case, state_dict=SNAPSHOT.get(case.label)) for case in cases_of(INSTALLED)]


def exempted(case):
    known = INSTALLED.plugin.exemptions
    return {**known.get(case.component, {}), **known.get(case.config, {})}


def test_state_dicts_of_all_cases_are_pinned_and_no_others():
    assert SNAPSHOT.keys() == {case.label for case in CASES if case.has_parameters}


@parametrize_with_checks(CASES, tiers=["core"], expected_failures=exempted)
def test_contract(check):
    check()
