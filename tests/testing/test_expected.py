"""Failures that are known: for which case, how they end, and that they still happen."""

from __future__ import annotations

import pytest
from contract_mutants.modules import Counts, ForgetsFloat64
from torch import Tensor

from qgs.components import FreeCenters, MlpFeedForward
from qgs.testing import (
    CHECKS,
    Case,
    ContractError,
    ExpectedError,
    checks_for,
    parametrize_with_checks,
    run_check,
)

COUNTS = Case(Counts.Config())
SINGLE = "float64_stays_float64"


class SingleOnly(MlpFeedForward):
    name = "single_only"

    def forward(self, features: Tensor) -> Tensor:
        if features.dtype.itemsize > 4:
            raise NotImplementedError("the kernel has no float64")
        return super().forward(features)


def _made(case: Case, name: str, expected_failures) -> None:
    mark = parametrize_with_checks([case], expected_failures=expected_failures).mark
    next(p.values[0] for p in mark.args[1] if p.id.endswith(f"-{name}"))()


def test_they_are_strict() -> None:
    reasons = {"forward_keeps_no_state": "it counts", "config_is_frozen": "it might fail"}
    with pytest.raises(pytest.xfail.Exception, match=r"it counts \(seen: .* changes calls"):
        _made(COUNTS, "forward_keeps_no_state", reasons)
    with pytest.raises(pytest.fail.Exception, match="passes, although it is expected to fail"):
        _made(COUNTS, "config_is_frozen", reasons)


def test_a_reason_excuses_no_error() -> None:
    case = Case(SingleOnly.Config())
    with pytest.raises(pytest.fail.Exception) as failure:
        _made(case, SINGLE, {SINGLE: "float32 is enough"})
    told = str(failure.value)
    assert "seen: NotImplementedError: the kernel has no float64" in told
    assert "expected: a broken contract: float32 is enough" in told
    assert "write ExpectedError(NotImplementedError, ...)" in told


def test_an_error_is_expected_by_its_class() -> None:
    case, kernel = Case(SingleOnly.Config()), "there is no kernel"
    for error in (NotImplementedError, RuntimeError, (OSError, NotImplementedError)):
        with pytest.raises(pytest.xfail.Exception, match=f"{kernel}.*the kernel has no float64"):
            _made(case, SINGLE, {SINGLE: ExpectedError(error, kernel)})
    with pytest.raises(pytest.fail.Exception, match="expected: OSError: there is no kernel"):
        _made(case, SINGLE, {SINGLE: ExpectedError(OSError, kernel)})


def test_an_expected_error_excuses_no_broken_contract() -> None:
    outcome = run_check(
        CHECKS[SINGLE], Case(ForgetsFloat64.Config()), ExpectedError(TypeError, "no kernel")
    )
    assert outcome.verdict == "failed"
    assert "expected: TypeError: no kernel" in outcome.message


def test_they_may_depend_on_the_case() -> None:
    unbounded, bounded = FreeCenters.Config(output_limit=None), FreeCenters.Config()
    name = "large_numbers_stay_finite"
    given = {unbounded: {name: "it has no limit"}, bounded: {}}
    mark = parametrize_with_checks(
        [Case(config) for config in given], expected_failures=lambda case: given[case.config]
    ).mark
    checks = [p.values[0] for p in mark.args[1] if p.id.endswith(name)]
    with pytest.raises(pytest.xfail.Exception, match="it has no limit"):
        checks[0]()
    checks[1]()


@pytest.mark.parametrize(
    ("name", "expected", "message"),
    [
        ("config_is_frosen", "why", "did you mean `config_is_frozen`"),
        ("supervision_weights", "why", "applies to none of the cases, but to supervision"),
        ("runs", "why", "`runs` cannot be expected to fail"),
        ("builds", ExpectedError(OSError, "why"), "`builds` cannot be expected to fail"),
        ("config_is_frozen", " ", "`config_is_frozen` needs a reason"),
        ("config_is_frozen", None, "`config_is_frozen` needs a reason"),
        ("config_is_frozen", ExpectedError(OSError, ""), "`config_is_frozen` needs a reason"),
        ("config_is_frozen", ExpectedError(Exception, "why"), "name the class it is of"),
        ("config_is_frozen", ExpectedError((), "why"), "name the class it is of"),
        ("config_is_frozen", 3, "is 3; write the reason as a text"),
        ("config_is_frozen", ["a"], "write the reason as a text"),
        ("config_is_frozen", ExpectedError(AssertionError, "why"), "a broken contract is too"),
        ("config_is_frozen", ExpectedError((OSError, ContractError), "why"), "contract is too"),
    ],
)
def test_those_that_cannot_be_are_refused(name, expected, message) -> None:
    for given in ({name: expected}, lambda case: {name: expected}):
        with pytest.raises(ValueError, match=message):
            parametrize_with_checks([COUNTS], expected_failures=given)
    if expected is not None and name in {check.name for check in checks_for(COUNTS)}:
        with pytest.raises(ValueError, match=message):
            run_check(CHECKS[name], COUNTS, expected)


@pytest.mark.parametrize("given", [["config_is_frozen"], "config_is_frozen", lambda case: None])
def test_what_is_no_mapping_is_refused(given) -> None:
    with pytest.raises(TypeError, match="the expected failures are no mapping but"):
        parametrize_with_checks([COUNTS], expected_failures=given)
