"""Run the checks of a case and report how they went, alone or as a pytest test."""

import sys
import traceback
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, TypeAlias

from qgs.contracts.component import MissingExtraError
from qgs.recipe.errors import did_you_mean
from qgs_dev.case import CannotCheck, Case, ContractError
from qgs_dev.registry import BASICS, CHECKS, TIERS, Check, Tier, checks_for

Verdict: TypeAlias = Literal["passed", "failed", "skipped", "expected failure", "unexpected pass"]


@dataclass(frozen=True)
class CheckResult:
    """How a check of a case went. message: why it did not simply pass."""

    case: Case
    check: Check
    verdict: Verdict
    message: str = ""

    @property
    def ok(self) -> bool:
        """True if nothing is to be mended."""
        return self.verdict not in ("failed", "unexpected pass")

    @property
    def leaves_unchecked(self) -> bool:
        """True if the component could not be built or called here."""
        return self.verdict == "skipped" and self.check.name in BASICS


@dataclass
class CaseRun:
    """All checks of one case. After `builds` or `runs` fails, the rest is skipped.

    expected: check -> why it fails; such a check that passes is a failure.
    variant: whether another case of its class comes before it; see `Check.variants`.
    """

    case: Case
    expected: Mapping[str, str] = field(default_factory=dict)
    variant: bool = False

    def __str__(self) -> str:
        return self.case.label

    def results(self, tiers: Iterable[Tier] = TIERS) -> Iterator[CheckResult]:
        """How each check went, in their order."""
        cause = ""
        for check in checks_for(self.case, tiers, self.variant):
            if cause:
                message = f"`{cause}` fails: see that check"
                yield CheckResult(self.case, check, "skipped", message)
                continue
            result = run_check(check, self.case, self.expected.get(check.name, ""))
            # One cause is one failure: what cannot run fails every other check.
            if check.name in BASICS and not result.ok:
                cause = check.name
            yield result

    def check(self, tiers: Iterable[Tier] = TIERS) -> None:
        """Make all checks inside of a pytest test, which fails with the messages of all that fail.

        It is skipped where the component cannot be built or called. tiers: some of TIERS.
        """
        import pytest

        results = list(self.results(tiers))
        failures = [result.message for result in results if not result.ok]
        if failures:
            pytest.fail("\n\n".join(failures), pytrace=False)
        for result in results:
            if result.leaves_unchecked:
                pytest.skip(result.message)


def run_check(check: Check, case: Case, expected: str = "") -> CheckResult:
    """Run `check` on `case`. expected: why it is known to fail; then passing is a fault."""
    assert case.slot in check.slots, f"`{check.name}` is not for {case.label}"
    title = f"{case.label}: {check.name}"
    try:
        check.function(case)
    except (CannotCheck, MissingExtraError) as error:
        return CheckResult(case, check, "skipped", str(error))
    # SystemExit: a component that ends the process would end the suite.
    except (Exception, SystemExit) as error:
        seen = with_place(error, case.component)
        if expected:
            return CheckResult(case, check, "expected failure", f"{expected} (seen: {seen})")
        message = f"{title}\n  seen: {seen}\n  contract: {check.contract}"
        return CheckResult(case, check, "failed", message)
    if not expected:
        return CheckResult(case, check, "passed")
    fix = "drop the expected failure, or restrict it to the options with which it fails"
    why = f"{title} passes, although it is expected to fail: {expected}\n  fix: {fix}"
    return CheckResult(case, check, "unexpected pass", why)


def refuse_unexpectable(expected: Mapping[str, str], runs: Iterable[CaseRun]) -> None:
    """Raise ValueError for an expected failure of no check, of no run, or without a reason.

    expected: name of a check -> why it fails.
    """
    made = {check.name for run in runs for check in checks_for(run.case, variant=run.variant)}
    for name, why in expected.items():
        if name not in CHECKS:
            fix = did_you_mean(str(name), CHECKS, "checks")
            raise ValueError(f"there is no check `{name}`; {fix}")
        if name in BASICS or name not in made:
            slots = ", ".join(sorted(CHECKS[name].slots))
            kept = "" if CHECKS[name].variants else " and the first case of a class"
            raise ValueError(f"`{name}` cannot be expected to fail here; it is for {slots}{kept}")
        if not (isinstance(why, str) and why.strip()):
            raise ValueError(f"the expected failure of `{name}` needs a reason, as a text")


def with_place(error: BaseException, component: type) -> str:
    """Type and message of `error`, and FILE:LINE of the component's package that raised it.

    A broken contract has no place, nor does what was raised elsewhere.
    """
    # Notes say where in a check it happened.
    noted = "".join(f"{note}, " for note in getattr(error, "__notes__", ()))
    if isinstance(error, ContractError):
        return f"{noted}{error}"
    what = f"{noted}{type(error).__name__}"
    what = f"{what}: {error}" if str(error) else what
    file = getattr(sys.modules.get(component.__module__), "__file__", None)
    if file is None:
        return what
    package = Path(file).resolve()
    while (package.parent / "__init__.py").exists():
        package = package.parent
    # The innermost place in the package, not where torch or the suite raised it.
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        if Path(frame.filename).resolve().is_relative_to(package):
            return f"{what} (raised under {frame.filename}:{frame.lineno})"
    return what
