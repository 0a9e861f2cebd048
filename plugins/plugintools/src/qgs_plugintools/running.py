"""Run the checks of a case and report how they went, alone or as pytest tests."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

from qgs.composer.errors import did_you_mean
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

ExpectedFailures: TypeAlias = Mapping[str, str] | Callable[[Case], Mapping[str, str]]
"""Check -> why it fails, for all cases, or as a function of the case."""


@dataclass(frozen=True)
class CheckResult:
    """How a check of a case went. message: why it did not simply pass."""

    case: Case
    check: Check
    verdict: Verdict
    message: str = ""

    @property
    def ok(self) -> bool:
        """Whether nothing is to be mended."""
        return self.verdict not in ("failed", "unexpected pass")

    @property
    def leaves_unchecked(self) -> bool:
        """Whether the component could not be built or called here."""
        return self.verdict == "skipped" and self.check.name in BASICS


class CaseRun:
    """The checks of one case, one after the other. After `builds` or `runs` the rest is skipped."""

    def __init__(self, case: Case, expected: Mapping[str, str] | None = None) -> None:
        self.case = case
        self.expected = expected or {}
        self.cause = ""

    def make(self, check: Check) -> CheckResult:
        """Run the next check."""
        if self.cause not in ("", check.name):
            return CheckResult(self.case, check, "skipped", f"`{self.cause}` fails: see that check")
        result = run_check(check, self.case, self.expected.get(check.name, ""))
        if check.name in BASICS:
            self.cause = "" if result.ok else check.name
        return result


def run_check(check: Check, case: Case, expected: str = "") -> CheckResult:
    """Run `check` on `case`. expected: why it is known to fail; then passing is a fault.

    Raises ValueError for a check of other slots.
    """
    if case.slot not in check.slots:
        raise ValueError(f"the check `{check.name}` is not for {case.label}; see checks_for(case)")
    title = f"{case.label}: {check.name}"
    try:
        check.function(case)
    except (CannotCheck, MissingExtraError) as error:
        return CheckResult(case, check, "skipped", str(error))
    # SystemExit: a component that ends the process would end the suite.
    except (Exception, SystemExit) as error:
        seen = with_place(error, file_of(case.component))
        if expected:
            return CheckResult(case, check, "expected failure", f"{expected} (seen: {seen})")
        message = f"{title}\n  seen: {seen}\n  contract: {check.contract}"
        return CheckResult(case, check, "failed", message)
    if not expected:
        return CheckResult(case, check, "passed")
    fix = "drop the expected failure, or restrict it to the options with which it fails"
    why = f"{title} passes, although it is expected to fail: {expected}\n  fix: {fix}"
    return CheckResult(case, check, "unexpected pass", why)


def refuse_unexpectable(expected: Mapping[str, Any], cases: Iterable[Case]) -> None:
    """Raise ValueError for an expected failure of no check, of no case, or without a reason.

    expected: name of a check -> why it fails.
    """
    slots = {case.slot for case in cases}
    for name, why in expected.items():
        if name not in CHECKS:
            fix = did_you_mean(str(name), CHECKS, "checks")
            raise ValueError(f"there is no check `{name}`; {fix}")
        if not slots & set(CHECKS[name].slots) or name in BASICS:
            others = ", ".join(sorted(CHECKS[name].slots))
            raise ValueError(f"`{name}` cannot be expected to fail here; it is for {others}")
        if not (isinstance(why, str) and why.strip()):
            raise ValueError(f"the expected failure of `{name}` needs a reason, as a text")


def with_place(error: BaseException, file: str | None) -> str:
    """Type and message of `error`, and the place in the component's package that raised it.

    file: the one that defines the component, None if there is none. A broken contract has no place.
    """
    if isinstance(error, ContractError):
        return str(error)
    what = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
    place = place_in(error, [package_of(file)]) if file else ""
    return f"{what} (raised under {place})" if place else what


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
        A check that passes nevertheless is a failure.
    tiers: "core", "extended".
    Raises TypeError if `cases` is not a list of cases, at least one; ValueError for unknown tiers
    and expected failures that no check can have.
    """
    import pytest

    chosen, wanted = list(cases), checked_tiers(tiers)
    if not chosen or not all(isinstance(case, Case) for case in chosen):
        raise TypeError(f"{cases!r} is no list of cases; give [Case(MyComponent.Config())]")
    parameters = []
    for case in chosen:
        expected = expected_failures(case) if callable(expected_failures) else expected_failures
        refuse_unexpectable(expected or {}, [case] if callable(expected_failures) else chosen)
        run = CaseRun(case, expected)
        parameters += [
            pytest.param(BoundCheck(check, run), id=f"{case.label}-{check.name}")
            for check in checks_for(case, wanted)
        ]
    return pytest.mark.parametrize("check", parameters)
