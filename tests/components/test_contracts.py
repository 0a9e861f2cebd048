"""Every component of the framework and of LocusGS keeps its contract, and the names of weights."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from qgs_plugintools import CHECKS, Case, cases_of, parametrize_with_checks, run_check

from qgs.components import FreeCenters
from qgs.composer.registry import load_plugin

CASES = [case for plugin in ("qgs", "locus") for case in cases_of(load_plugin(plugin))]
TOKENGS_CENTERS = FreeCenters.Config(input_limit=None, output_limit=None)

SNAPSHOT = json.loads((Path(__file__).parent / "state_dicts.json").read_text())
"""Label of a case -> name -> shape in its state dict, so that saved weights stay loadable."""
PARAMETRIC = {case.label: case for case in CASES if case.has_parameters}


@parametrize_with_checks(CASES, tiers=["core"])
def test_contract(check):
    check()


@pytest.mark.slow
@parametrize_with_checks(CASES, tiers=["extended"])
def test_extended_contract(check):
    check()


@parametrize_with_checks(
    [Case(TOKENGS_CENTERS)],
    expected_failures={
        "large_numbers_stay_finite": "TokenGS as published places Gaussians at exp|t|, unbounded"
    },
    tiers=["core"],
)
def test_contract_of_tokengs_as_published(check):
    check()


def test_state_dicts_of_all_cases_are_pinned_and_no_others() -> None:
    assert SNAPSHOT.keys() == PARAMETRIC.keys()


@pytest.mark.parametrize("label", PARAMETRIC)
def test_names_in_state_dicts_stay(label: str) -> None:
    known = replace(PARAMETRIC[label], state_dict=SNAPSHOT[label])
    result = run_check(CHECKS["state_dict_keys"], known)
    assert result.ok, result.message
