"""Every component keeps its contract, as `qgs check-plugin landmark` says too."""

import json
from dataclasses import replace
from pathlib import Path

from qgs_plugintools import cases_of, parametrize_with_checks

from qgs.composer.registry import load_plugin

SNAPSHOT = json.loads((Path(__file__).parent / "state_dicts.json").read_text())
"""Label of a case -> name -> shape in its state dict, so that saved weights stay loadable."""

CASES = [
    replace(case, state_dict=SNAPSHOT.get(case.label)) for case in cases_of(load_plugin("landmark"))
]


def test_state_dicts_of_all_cases_are_pinned_and_no_others():
    assert SNAPSHOT.keys() == {case.label for case in CASES if case.has_parameters}


@parametrize_with_checks(CASES, tiers=["core"])
def test_contract(check):
    check()
