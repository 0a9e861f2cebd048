"""Making checks of one case, and telling how they went."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias

from qgs.composer.registry import file_of
from qgs.contracts import Expected, ExpectedError
from qgs.contracts.component import MissingExtraError
from qgs.testing.case import Case
from qgs.testing.expected import expectation_fault, is_expected, reason_of
from qgs.testing.faults import CannotCheck, ContractError
from qgs.testing.places import raised
from qgs.testing.registry import BASICS, CHECKS, LIKELY_CAUSES, Check, case_given
from qgs.testing.wording import named

Verdict: TypeAlias = Literal["passed", "failed", "skipped", "expected failure", "unexpected pass"]


@dataclass(frozen=True)
class Outcome:
    """How a check of a case went.

    message: why it did not simply pass. cause: the check that tells why this one could not be
    made, "" for every outcome of its own. crashed: whether it failed with an error, and not by
    seeing the contract broken.
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
        """Whether the component could not be built, or not be called, in this place."""
        return self.verdict == "skipped" and self.check.name in BASICS and not self.cause


class CaseRun:
    """Checks of one case, made one after the other, in which one cause is told once.

    After `builds` or `runs` failed, a check that ends with an error is skipped and refers to it:
    a component that cannot be built or called ends all of them. One that sees the contract broken
    fails, and one that can be made passes. After one of LIKELY_CAUSES failed, the failures of
    others name it.
    """

    def __init__(self, case: Case, expected: Mapping[str, Expected] | None = None) -> None:
        self.case = case
        self.expected = expected or {}
        self.cause = ""
        self.likely: set[str] = set()

    def make(self, check: Check) -> Outcome:
        """Make the next check."""
        outcome = run_check(check, self.case, self.expected.get(check.name))
        if outcome.verdict != "failed":
            self.cause = "" if check.name == self.cause else self.cause
            self.likely.discard(check.name)
            return outcome
        if self.cause and outcome.crashed and check.name != self.cause:
            why = f"ends with an error as `{self.cause}` does: see that check"
            return replace(outcome, verdict="skipped", message=why, cause=self.cause)
        if check.name in BASICS:
            self.cause = check.name
        elif check.name in LIKELY_CAUSES:
            self.likely.add(check.name)
        elif self.likely:
            causes = " and ".join(f"`{name}`" for name in LIKELY_CAUSES if name in self.likely)
            told = f"{outcome.message}\n  likely cause: that of {causes}; mend this first"
            return replace(outcome, message=told)
        return outcome


def run_check(check: Check, case: Case, expected: Expected | None = None) -> Outcome:
    """Make `check` of `case`. expected: why it is known to fail; then a pass is a fault.

    Raises TypeError for what is no check or no case, ValueError for a check of other slots and for
    what no check can be expected to fail with.
    """
    _refuse_others(check, case, expected)
    try:
        check.function(case)
    except (CannotCheck, MissingExtraError) as error:
        return Outcome(case, check, "skipped", str(error))
    except (Exception, SystemExit) as error:
        return _failed(check, case, error, expected)
    if expected is None:
        return Outcome(case, check, "passed")
    why = f"{case.label}: {check.name} passes, although it is expected to fail: "
    fix = "drop the expected failure, or restrict it to the options with which it fails"
    return Outcome(case, check, "unexpected pass", f"{why}{reason_of(expected)}\n  fix: {fix}")


def _refuse_others(check: Any, case: Any, expected: Any) -> None:
    if not isinstance(check, Check):
        fix = CHECKS[check].name if isinstance(check, str) else "runs"
        raise TypeError(f'{named(check)} is no check; give CHECKS["{fix}"], then the case')
    case_given(case)
    if case.slot not in check.slots:
        slots = ", ".join(sorted(check.slots))
        raise ValueError(
            f"the check `{check.name}` applies to {slots}, and {case.label} is none of them; "
            "checks_for(case) lists those that apply"
        )
    fault = "" if expected is None else expectation_fault(check.name, expected, [case])
    if fault:
        raise ValueError(fault)


def _failed(check: Check, case: Case, error: BaseException, expected: Expected | None) -> Outcome:
    crashed = not isinstance(error, ContractError)
    seen = raised(error, file_of(case.component)) if crashed else error.seen
    if expected is not None and is_expected(error, expected):
        told = f"{reason_of(expected)} (seen: {seen})"
        return Outcome(case, check, "expected failure", told, crashed=crashed)
    told = f"{case.label}: {check.name}\n  seen: {seen}\n  contract: {check.contract}"
    if expected is not None:
        told += f"\n  expected: {_otherwise(error, expected)}"
    return Outcome(case, check, "failed", told, crashed=crashed)


def _otherwise(error: BaseException, expected: Expected) -> str:
    """What was expected instead of `error`, and what to write if `error` is meant."""
    if isinstance(expected, ExpectedError):
        kinds = expected.error if isinstance(expected.error, tuple) else (expected.error,)
        return f"{' or '.join(kind.__name__ for kind in kinds)}: {expected.reason}"
    fix = f"ExpectedError({type(error).__name__}, ...) if the error is meant"
    return f"a broken contract: {expected}\n  fix: mend the error, or write {fix}"
