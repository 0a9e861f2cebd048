"""How checks are run and reported: causes, places of errors, expected failures, arguments."""

import sys
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import ClassVar

import pytest
import torch
from contract_mutants import basics
from contract_mutants.basics import RaisesWhenBuilt, RaisesWhenCalled
from contract_mutants.fields import Steps
from contract_mutants.options import IgnoresUnknownOptions, LosesAnOption
from contract_mutants.precision import GivesFloat32, TurnsInFull
from contract_mutants.state import AddsNoise, CountsItsCalls
from pydantic import ConfigDict
from qgs_plugintools import (
    CHECKS,
    Case,
    CaseRun,
    ContractError,
    ExpectedError,
    checks_for,
    parametrize_with_checks,
    run_check,
)
from torch import Tensor

from qgs.components import FreeCenters, MlpFeedForward
from qgs.contracts import Centers, Component, MissingExtraError, ViewsConfig

CASE = Case(MlpFeedForward.Config())
COUNTS = Case(CountsItsCalls.Config())
BROKEN = Path(basics.__file__)
STATE, FROZEN, SINGLE = "forward_keeps_no_state", "config_round_trip", "float64_stays_float64"


def _bound(cases: list[Case], **options) -> dict:
    """The checks as pytest calls them, by the ids of their tests."""
    mark = parametrize_with_checks(cases, **options).mark
    return {parameter.id: parameter.values[0] for parameter in mark.args[1]}


def test_a_failure_says_what_was_seen_and_what_the_contract_says() -> None:
    check = _bound([Case(AddsNoise.Config())])["feed_forward/adds_noise-eval_repeats_bitwise"]
    with pytest.raises(pytest.fail.Exception) as failure:
        check()
    lines = str(failure.value).splitlines()
    assert lines[0] == "feed_forward/adds_noise: eval_repeats_bitwise"
    assert lines[1].startswith("  seen: the second time output: values differ by up to")
    assert lines[2].startswith("  contract: In evaluation the same inputs give")


@pytest.mark.parametrize(
    ("component", "check", "culprit"),
    [
        (RaisesWhenBuilt, "builds", "raise RuntimeError"),
        (RaisesWhenCalled, "runs", "features @ torch.ones(3, 3)"),
    ],
)
def test_an_error_is_reported_with_its_place_in_the_component(component, check, culprit) -> None:
    lines = BROKEN.read_text().splitlines()
    line = 1 + [culprit in text for text in lines].index(True)
    result = run_check(CHECKS[check], Case(component.Config()))
    assert f" (raised under {BROKEN}:{line})\n" in result.message


PLACED = """
from qgs.components import MlpFeedForward
from placed_package.maths import root

class Placed(MlpFeedForward):
    name = "placed"

    def forward(self, features):
        return root(super().forward(features))
"""
MATHS = """
import torch

def root(x):
    return torch.linalg.cholesky(x.mT @ x - 1e6)
"""


def test_the_place_may_be_anywhere_in_the_package(tmp_path, monkeypatch) -> None:
    package = tmp_path / "placed_package"
    for folder in (package, package / "attention"):
        folder.mkdir()
        (folder / "__init__.py").touch()
    (package / "attention" / "placed.py").write_text(PLACED)
    (package / "maths.py").write_text(MATHS)
    monkeypatch.syspath_prepend(tmp_path)
    placed = import_module("placed_package.attention.placed").Placed
    result = run_check(CHECKS["runs"], Case(placed.Config()))
    assert f"(raised under {package / 'maths.py'}:5)" in result.message


def test_a_class_of_no_file_has_a_place_too() -> None:
    scope = {"__name__": "of_no_file", "root": partial(torch.linalg.cholesky)}
    exec(PLACED.replace("from placed_package.maths import root", ""), scope)
    result = run_check(CHECKS["runs"], Case(scope["Placed"].Config()))
    assert "(raised under <string>:9)" in result.message


@pytest.mark.parametrize(
    ("component", "cause"), [(RaisesWhenBuilt, "builds"), (RaisesWhenCalled, "runs")]
)
def test_one_cause_is_one_failure(component, cause) -> None:
    run = CaseRun(Case(component.Config()))
    results = [run.make(check) for check in checks_for(run.case, ["core"])]
    assert [r.check.name for r in results if not r.ok] == [cause]
    skipped = [r for r in results if r.verdict == "skipped"]
    assert len(skipped) > 20
    assert {(r.cause, r.message) for r in skipped} == {
        (cause, f"ends with an error as `{cause}` does: see that check")
    }
    assert "config_round_trip" in {r.check.name for r in results if r.verdict == "passed"}


def test_what_is_seen_to_break_the_contract_is_reported_besides() -> None:
    class LaxAndRaises(RaisesWhenCalled):
        name = "lax_and_raises"

        class Config(RaisesWhenCalled.Config):
            model_config = ConfigDict(extra="ignore")

    run = CaseRun(Case(LaxAndRaises.Config()))
    results = {check.name: run.make(check) for check in checks_for(run.case, ["core"])}
    failed = {name for name, result in results.items() if not result.ok}
    assert failed == {"runs", "misspelt_option_is_refused"}


def test_a_check_alone_reports_its_own_error() -> None:
    """As with `pytest -k`: nothing is skipped for a cause that was not reported."""
    checks = _bound([Case(RaisesWhenCalled.Config())])
    checks = {name.rpartition("-")[2]: check for name, check in checks.items()}
    with pytest.raises(pytest.fail.Exception, match="mat1 and mat2"):
        checks["sizes_vary"]()
    with pytest.raises(pytest.fail.Exception, match="mat1 and mat2"):
        checks["runs"]()
    with pytest.raises(pytest.skip.Exception, match="as `runs` does"):
        checks["sizes_vary"]()


class FailsAtFirst(MlpFeedForward):
    name = "fails_at_first"
    calls: ClassVar[list[int]] = []

    def forward(self, features: Tensor) -> Tensor:
        self.calls.append(1)
        if len(self.calls) == 1 or features.dtype == torch.float64:
            raise RuntimeError("not now")
        return super().forward(features)


def test_a_cause_that_went_away_excuses_nothing() -> None:
    """As with tests that are run again where they failed."""
    run = CaseRun(Case(FailsAtFirst.Config()))
    verdicts = [run.make(CHECKS[name]).verdict for name in ("runs", "runs", SINGLE)]
    assert verdicts == ["failed", "passed", "failed"]


def test_likely_causes_come_first() -> None:
    names = [check.name for check in checks_for(CASE)]
    assert names[:4] == ["builds", "runs", STATE, "eval_repeats_bitwise"]


def test_tiers_divide_the_checks() -> None:
    core, extended = (checks_for(CASE, [tier]) for tier in ("core", "extended"))
    assert [check.name for check in extended] == ["compiles"]
    assert len(core) + len(extended) == len(checks_for(CASE))


class SingleOnly(MlpFeedForward):
    name = "single_only"

    def forward(self, features: Tensor) -> Tensor:
        if features.dtype.itemsize > 4:
            raise NotImplementedError("the kernel has no float64")
        return super().forward(features)


def _make(case: Case, name: str, expected_failures) -> None:
    checks = _bound([case], expected_failures=expected_failures)
    checks[f"{case.label}-{name}"]()


def test_expected_failures_are_strict() -> None:
    reasons = {STATE: "it counts", FROZEN: "it might fail"}
    with pytest.raises(pytest.xfail.Exception, match=r"it counts \(seen: .* changes calls"):
        _make(COUNTS, STATE, reasons)
    with pytest.raises(pytest.fail.Exception, match="passes, although it is expected to fail"):
        _make(COUNTS, FROZEN, reasons)


def test_a_reason_excuses_no_error() -> None:
    with pytest.raises(pytest.fail.Exception) as failure:
        _make(Case(SingleOnly.Config()), SINGLE, {SINGLE: "float32 is enough"})
    message = str(failure.value)
    assert "seen: NotImplementedError: the kernel has no float64" in message
    assert "expected: a broken contract: float32 is enough" in message
    assert "ExpectedError(NotImplementedError, ...)" in message


def test_an_error_is_expected_by_its_class() -> None:
    case, kernel = Case(SingleOnly.Config()), "there is no kernel"
    for error in (NotImplementedError, RuntimeError, (OSError, NotImplementedError)):
        with pytest.raises(pytest.xfail.Exception, match=f"{kernel}.*the kernel has no float64"):
            _make(case, SINGLE, {SINGLE: ExpectedError(error, kernel)})
    with pytest.raises(pytest.fail.Exception, match=r"expected: .*OSError.*: there is no kernel"):
        _make(case, SINGLE, {SINGLE: ExpectedError(OSError, kernel)})


def test_an_expected_error_excuses_no_broken_contract() -> None:
    expected = ExpectedError(TypeError, "no kernel")
    result = run_check(CHECKS[SINGLE], Case(GivesFloat32.Config()), expected)
    assert result.verdict == "failed"
    assert "TypeError'>: no kernel" in result.message


def test_expected_failures_may_depend_on_the_case() -> None:
    unbounded, bounded = FreeCenters.Config(output_limit=None), FreeCenters.Config()
    name = "large_numbers_stay_finite"
    given = {unbounded: {name: "it has no limit"}, bounded: {}}
    checks = _bound(
        [Case(config) for config in given], expected_failures=lambda case: given[case.config]
    )
    first, second = (check for label, check in checks.items() if label.endswith(name))
    with pytest.raises(pytest.xfail.Exception, match="it has no limit"):
        first()
    second()


@pytest.mark.parametrize(
    ("name", "expected", "message"),
    [
        ("config_round_tip", "why", "did you mean `config_round_trip`"),
        ("supervision_weights", "why", "applies to none of the cases, but to supervision"),
        ("runs", "why", "`runs` cannot fail as expected"),
        ("builds", ExpectedError(OSError, "why"), "`builds` cannot fail as expected"),
        (FROZEN, " ", "needs a reason"),
        (FROZEN, 3, "needs a reason, as a text"),
        (FROZEN, ExpectedError(OSError, ""), "needs a reason"),
        (FROZEN, ExpectedError(Exception, "why"), "name a class"),
        (FROZEN, ExpectedError((), "why"), "name a class"),
        (FROZEN, ExpectedError(AssertionError, "why"), "name a class"),
        (FROZEN, ExpectedError((OSError, ContractError), "why"), "name a class"),
    ],
)
def test_expected_failures_that_cannot_be_are_refused(name, expected, message) -> None:
    for given in ({name: expected}, lambda case: {name: expected}):
        with pytest.raises(ValueError, match=message):
            parametrize_with_checks([COUNTS], expected_failures=given)
    if name == FROZEN:
        with pytest.raises(ValueError, match=message):
            run_check(CHECKS[name], COUNTS, expected)


@pytest.mark.parametrize(
    "given", [CASE, MlpFeedForward.Config(), MlpFeedForward, [MlpFeedForward], "mlp", None, []]
)
def test_what_is_no_list_of_cases_is_refused(given) -> None:
    told = r"no list of cases; give \[Case\(MyComponent.Config\(\)\)|is not iterable"
    with pytest.raises(TypeError, match=told):
        parametrize_with_checks(given)


def test_cases_may_come_from_a_generator() -> None:
    assert parametrize_with_checks(case for case in [CASE])


class Slotless(Component):
    name = "slotless"


class Formless(Centers):
    name = "formless"


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (MlpFeedForward, r"write Case\(MyComponent.Config\(\)\)"),
        (MlpFeedForward.Config, r"write Case\(MyComponent.Config\(\)\)"),
        (ViewsConfig(), "ViewsConfig holds options of no component"),
        (Slotless.Config(), "Slotless cannot be checked: which implements no slot's contract"),
        (Centers.Config(), "Centers cannot be checked: which has no `name`"),
        (Formless.Config(), "Formless cannot be checked: which leaves forward abstract"),
    ],
)
def test_what_cannot_be_checked_is_refused(given, message) -> None:
    with pytest.raises(TypeError, match=message):
        Case(given)


def test_fields_of_a_case_are_those_of_its_component() -> None:
    assert Case(TurnsInFull.Config(), fields={"place.center": abs}).fields
    with pytest.raises(ValueError, match=r"did you mean `place\.center`"):
        Case(Steps.Config(), fields={"place.centre": abs})


def test_a_case_is_labelled_by_options_that_yaml_does_not_get() -> None:
    assert Case(LosesAnOption.Config(shift=0.5)).label == "centers/loses_an_option(shift: 0.5)"


def test_a_check_of_another_slot_is_refused() -> None:
    with pytest.raises(ValueError, match="is not for centers/ignores_unknown_options"):
        run_check(CHECKS["head_gives_gaussians"], Case(IgnoresUnknownOptions.Config()))


@pytest.mark.parametrize("tiers", ["core", (), ["cor"], ["core", "all"]])
def test_unknown_tiers_are_refused(tiers) -> None:
    for use in (parametrize_with_checks, lambda cases, tiers: checks_for(cases[0], tiers)):
        with pytest.raises(ValueError, match="give a list of some of core, extended"):
            use([CASE], tiers=tiers)


def test_pytest_is_asked_for(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "pytest", None)
    refusal = None
    try:
        parametrize_with_checks([CASE])
    except MissingExtraError as error:
        refusal = error
    assert "needs pytest, which is not installed: run `pip install pytest`" in str(refusal)
