"""How checks are run and reported: causes, places of errors, expected failures, arguments."""

from pathlib import Path

import pytest
from contract_mutants import modules
from contract_mutants.modules import CachesByShape, RaisesWhenBuilt
from qgs_plugintools import (
    CHECKS,
    Case,
    CaseRun,
    checks_for,
    parametrize_with_checks,
    run_check,
)

from qgs.components import FreeCenters, MlpFeedForward

CASE = Case(MlpFeedForward.Config())
CACHES = Case(CachesByShape.Config())
STATE, FROZEN = "forward_keeps_no_state", "config_round_trip"


def bound(cases: list[Case], **options) -> dict:
    """The checks as pytest calls them, by the ids of their tests."""
    mark = parametrize_with_checks(cases, **options).mark
    return {parameter.id: parameter.values[0] for parameter in mark.args[1]}


def test_an_error_is_reported_with_its_place_in_the_component() -> None:
    file = Path(modules.__file__)
    culprit = "raise RuntimeError"
    line = 1 + [culprit in text for text in file.read_text().splitlines()].index(True)
    result = run_check(CHECKS["builds"], Case(RaisesWhenBuilt.Config()))
    assert f" (raised under {file}:{line})\n" in result.message


def test_one_cause_is_one_failure() -> None:
    run = CaseRun(Case(RaisesWhenBuilt.Config()))
    results = [run.make(check) for check in checks_for(run.case, ["core"])]
    assert [r.check.name for r in results if not r.ok] == ["builds"]
    assert {r.verdict for r in results[1:]} == {"skipped"}


def test_tiers_divide_the_checks_and_likely_causes_come_first() -> None:
    core, extended = (checks_for(CASE, [tier]) for tier in ("core", "extended"))
    assert [check.name for check in core[:4]] == ["builds", "runs", STATE, "eval_repeats_bitwise"]
    assert [check.name for check in extended] == ["compiles"]
    assert len(core) + len(extended) == len(checks_for(CASE))


def test_expected_failures_are_strict() -> None:
    checks = bound([CACHES], expected_failures={STATE: "a cache", FROZEN: "it might"})
    with pytest.raises(pytest.xfail.Exception, match=r"a cache \(seen: .* changes _cache"):
        checks[f"{CACHES.label}-{STATE}"]()
    with pytest.raises(pytest.fail.Exception, match="passes"):
        checks[f"{CACHES.label}-{FROZEN}"]()


def test_expected_failures_may_depend_on_the_case() -> None:
    unbounded, bounded = FreeCenters.Config(output_limit=None), FreeCenters.Config()
    name = "large_numbers_stay_finite"
    given = {unbounded: {name: "it has no limit"}, bounded: {}}
    checks = bound(
        [Case(config) for config in given], expected_failures=lambda case: given[case.config]
    )
    first, second = (check for label, check in checks.items() if label.endswith(name))
    with pytest.raises(pytest.xfail.Exception, match="it has no limit"):
        first()
    second()
