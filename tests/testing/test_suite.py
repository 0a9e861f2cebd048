"""The suite as its users meet it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from contract_mutants.modules import AddsNoise, Counts

from qgs.components import MlpFeedForward
from qgs.composer.registry import load_plugin
from qgs.contracts import CONTRACT_VERSION
from qgs.testing import CHECKS, Case, cases_of, checks_for, parametrize_with_checks, run_check

SNAPSHOT = Path(__file__).parent / "state_dicts.json"


def _bound(decorated) -> dict:
    return {parameter.id: parameter.values[0] for parameter in decorated.args[1]}


def test_a_failure_says_what_was_seen_and_what_the_contract_says() -> None:
    name = "feed_forward/adds_noise-eval_repeats_bitwise"
    check = _bound(parametrize_with_checks([Case(AddsNoise.Config())]).mark)[name]
    with pytest.raises(pytest.fail.Exception) as failure:
        check()
    lines = str(failure.value).splitlines()
    assert lines[0] == "feed_forward/adds_noise: eval_repeats_bitwise"
    assert lines[1].startswith("  seen: the second time output: values differ by up to")
    assert lines[2].startswith("  contract: In evaluation mode the same inputs give")


def test_tests_of_another_contract_version_are_refused() -> None:
    with pytest.raises(ValueError, match="contract version 99"):
        parametrize_with_checks([Case(Counts.Config())], contract_version=CONTRACT_VERSION + 98)


def test_tiers_share_out_the_checks() -> None:
    case = Case(MlpFeedForward.Config())
    core, extended = (checks_for(case, [tier]) for tier in ("core", "extended"))
    assert core
    assert [check.name for check in extended] == ["compiles"]
    assert len(core) + len(extended) == len(checks_for(case))


PARAMETRIC = {
    case.label: case
    for plugin in ("qgs", "locus")
    for case in cases_of(load_plugin(plugin))
    if case.has_parameters
}


def test_state_dicts_of_all_cases_are_pinned_and_no_others() -> None:
    assert json.loads(SNAPSHOT.read_text()).keys() == PARAMETRIC.keys()


@pytest.mark.parametrize("label", PARAMETRIC)
def test_names_in_state_dicts_stay(label: str) -> None:
    known = replace(PARAMETRIC[label], state_dict=json.loads(SNAPSHOT.read_text())[label])
    outcome = run_check(CHECKS["state_dict_keys"], known)
    assert outcome.ok, outcome.message


def test_a_pinned_name_that_moved_is_told() -> None:
    case = Case(MlpFeedForward.Config(), state_dict={"norm.weight": (32,)})
    outcome = run_check(CHECKS["state_dict_keys"], case)
    assert "saved weights would not load" in outcome.message
