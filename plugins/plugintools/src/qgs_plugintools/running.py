"""Run the checks of a case and report how they went, alone or as pytest tests."""

import traceback
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeAlias

import torch

from qgs.composer.errors import did_you_mean
from qgs.contracts import Expected, ExpectedError
from qgs.contracts.component import MissingExtraError
from qgs_plugintools.case import CannotCheck, Case, ContractError
from qgs_plugintools.places import file_of, package_of, place_in
from qgs_plugintools.registry import (
    BASICS,
    CHECKS,
    TIERS,
    Check,
    Tier,
    checked_tiers,
    checks_for,
)

Verdict: TypeAlias = Literal["passed", "failed", "skipped", "expected failure", "unexpected pass"]

ExpectedFailures: TypeAlias = Mapping[str, Expected] | Callable[[Case], Mapping[str, Expected]]
"""Check -> why it fails, for all cases, or as a function of the case."""

NOT_THE_AUTHORS = (Path(__file__).parent, Path(torch.__file__).parent)
"""Code that an error passes through but that a component's author cannot mend."""


@dataclass(frozen=True)
class CheckResult:
    """How a check of a case went.

    message: why it did not simply pass. cause: name of the failed check that explains why this one
    was skipped, else "". crashed: whether it ended with an error of the component's own code.
    """

    case: Case
    check: Check
    verdict: Verdict
    message: str = ""
    cause: str = ""
    crashed: bool = False

    @property
    def ok(self) -> bool:
        """Whether nothing is to be mended."""
        return self.verdict not in ("failed", "unexpected pass")

    @property
    def leaves_unchecked(self) -> bool:
        """Whether the component could not be built or called here."""
        return self.verdict == "skipped" and self.check.name in BASICS and not self.cause


class CaseRun:
    """The checks of one case, run one after the other, so that one cause is reported once.

    After `builds` or `runs` failed, checks that end with an error are skipped and refer to it.
    """

    def __init__(self, case: Case, expected: Mapping[str, Expected] | None = None) -> None:
        self.case = case
        self.expected = expected or {}
        self.cause = ""

    def make(self, check: Check) -> CheckResult:
        """Run the next check."""
        result = run_check(check, self.case, self.expected.get(check.name))
        if result.verdict != "failed":
            self.cause = "" if check.name == self.cause else self.cause
            return result
        if self.cause and result.crashed and check.name != self.cause:
            why = f"ends with an error as `{self.cause}` does: see that check"
            return replace(result, verdict="skipped", message=why, cause=self.cause)
        if check.name in BASICS:
            self.cause = check.name
        return result


def run_check(check: Check, case: Case, expected: Expected | None = None) -> CheckResult:
    """Run `check` on `case`. expected: why it is known to fail; then passing is a fault.

    Raises ValueError for a check of other slots, and for an expected failure that cannot be.
    """
    if case.slot not in check.slots:
        raise ValueError(f"the check `{check.name}` is not for {case.label}; see checks_for(case)")
    if expected is not None:
        refuse_unexpectable({check.name: expected}, [case])
    try:
        check.function(case)
    except (CannotCheck, MissingExtraError) as error:
        return CheckResult(case, check, "skipped", str(error))
    except (Exception, SystemExit) as error:
        return _failed(check, case, error, expected)
    if expected is None:
        return CheckResult(case, check, "passed")
    why = f"{case.label}: {check.name} passes, although it is expected to fail: "
    fix = "drop the expected failure, or restrict it to the options with which it fails"
    return CheckResult(case, check, "unexpected pass", f"{why}{_reason(expected)}\n  fix: {fix}")


def refuse_unexpectable(expected: Mapping[str, Any], cases: Iterable[Case]) -> None:
    """Raise ValueError for an expected failure of no check, of no case, or without a reason.

    expected: name of a check -> why it fails.
    """
    slots = {case.slot for case in cases}
    for name, why in expected.items():
        if name not in CHECKS:
            fix = did_you_mean(str(name), CHECKS, "checks")
            raise ValueError(f"there is no check `{name}`; {fix}")
        if not slots & set(CHECKS[name].slots):
            others = ", ".join(sorted(CHECKS[name].slots))
            raise ValueError(f"the check `{name}` applies to none of the cases, but to {others}")
        if name in BASICS:
            raise ValueError(f"`{name}` cannot fail as expected: no other check would mean a thing")
        reason = _reason(why)
        if not (isinstance(reason, str) and reason.strip()):
            raise ValueError(f"the expected failure of `{name}` needs a reason, as a text")
        kinds = why.error if isinstance(why, ExpectedError) else OSError
        kinds = kinds if isinstance(kinds, tuple) else (kinds,)
        if not kinds or any(issubclass(ContractError, kind) for kind in kinds):
            raise ValueError(
                f"the expected error of `{name}` is {kinds!r}; name a class that neither every "
                "error nor a broken contract (ContractError) is"
            )


def _reason(expected: Expected) -> str:
    return expected.reason if isinstance(expected, ExpectedError) else expected


def _failed(
    check: Check, case: Case, error: BaseException, expected: Expected | None
) -> CheckResult:
    crashed = not isinstance(error, ContractError)
    seen = with_place(error, file_of(case.component))
    awaited = expected.error if isinstance(expected, ExpectedError) else ContractError
    if expected is not None and isinstance(error, awaited):
        why = f"{_reason(expected)} (seen: {seen})"
        return CheckResult(case, check, "expected failure", why, crashed=crashed)
    message = f"{case.label}: {check.name}\n  seen: {seen}\n  contract: {check.contract}"
    if isinstance(expected, ExpectedError):
        message += f"\n  expected: {expected.error!r}: {expected.reason}"
    elif expected is not None:
        fix = f"ExpectedError({type(error).__name__}, ...) if the error is meant"
        message += f"\n  expected: a broken contract: {expected}\n  fix: mend the error, or {fix}"
    return CheckResult(case, check, "failed", message, crashed=crashed)


def with_place(error: BaseException, file: str | None) -> str:
    """Type and message of `error`, and the place in the component's package that raised it.

    file: the one that defines the component, None if there is none. An error that never passed
    its package is placed in the first frame outside of this suite and of torch. What breaks the
    contract has no place.
    """
    if isinstance(error, ContractError):
        return str(error)
    place = place_in(error, [package_of(file)]) if file else ""
    if not place:
        frames = traceback.extract_tb(error.__traceback__)
        files = [(frame, Path(frame.filename).resolve()) for frame in frames]
        others = [f for f, file in files if not any(map(file.is_relative_to, NOT_THE_AUTHORS))]
        frame = (others or frames[-1:])[0]
        place = f"{frame.filename}:{frame.lineno}"
    what = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
    return f"{what} (raised under {place})"


@dataclass(frozen=True)
class BoundCheck:
    """A check of a case, to be called inside a pytest test."""

    check: Check
    run: CaseRun

    def __call__(self) -> None:
        """Pass, or end the pytest test as failed, skipped or expected to fail."""
        import pytest

        result = self.run.make(self.check)
        if result.verdict == "skipped":
            pytest.skip(result.message)
        if result.verdict == "expected failure":
            pytest.xfail(result.message)
        if not result.ok:
            pytest.fail(result.message, pytrace=False)


def parametrize_with_checks(
    cases: Iterable[Case],
    *,
    expected_failures: ExpectedFailures | None = None,
    tiers: Iterable[Tier] = TIERS,
) -> Callable[[Callable[..., Any]], Any]:
    """Parametrise a pytest test with every check that applies to each case.

        @parametrize_with_checks([Case(MyAttention.Config())])
        def test_contract(check):
            check()

    expected_failures: check -> why the cases fail it, or a function that gives that for a case.
        A check that passes nevertheless is a failure. A reason is for a check that sees the
        contract broken; for one that ends with an error, write `ExpectedError(ItsClass, reason)`.
    tiers: "core", "extended".
    Raises TypeError if `cases` is not a list of cases, at least one; ValueError for unknown tiers
    and expected failures that no check can have; MissingExtraError without pytest.
    """
    try:
        import pytest
    except ModuleNotFoundError as error:
        raise MissingExtraError(
            "parametrize_with_checks needs pytest, which is not installed: run `pip install "
            "pytest`, or run the checks with `qgs check-plugin` or qgs_plugintools.run_check"
        ) from error
    chosen, wanted = list(cases), checked_tiers(tiers)
    if not chosen or not all(isinstance(case, Case) for case in chosen):
        raise TypeError(f"{cases!r} is no list of cases; give [Case(MyComponent.Config())]")
    parameters = []
    for case, expected in zip(chosen, _expected_of(expected_failures, chosen), strict=True):
        run = CaseRun(case, expected)
        parameters += [
            pytest.param(BoundCheck(check, run), id=f"{case.label}-{check.name}")
            for check in checks_for(case, wanted)
        ]
    return pytest.mark.parametrize("check", parameters)


def _expected_of(given: ExpectedFailures | None, cases: list[Case]) -> list[Mapping[str, Expected]]:
    """The known failures of each case."""
    if callable(given):
        found = [given(case) for case in cases]
        for case, expected in zip(cases, found, strict=True):
            refuse_unexpectable(expected, [case])
        return found
    refuse_unexpectable(given or {}, cases)
    return [given or {}] * len(cases)
