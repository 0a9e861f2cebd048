"""Failures that are known and stated with a reason."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, TypeAlias

from qgs.composer.suggest import did_you_mean
from qgs.contracts import Expected, ExpectedError
from qgs.testing.case import Case
from qgs.testing.faults import ContractError
from qgs.testing.registry import CHECKS
from qgs.testing.wording import described

ExpectedFailures: TypeAlias = Mapping[str, Expected] | Callable[[Case], Mapping[str, Expected]]
"""Check -> why it fails, for all cases, or as a function of the case."""

BASICS = ("builds", "runs")
"""Checks that nobody may be exempt from: without them the others mean nothing."""


def expected_of(
    given: ExpectedFailures | None, cases: Sequence[Case]
) -> list[Mapping[str, Expected]]:
    """The known failures of each case.

    Raises TypeError for what is no mapping, and ValueError for what no check of the cases can be.
    """
    if given is None:
        return [{}] * len(cases)
    if not isinstance(given, Mapping) and callable(given):
        return [_sound(given(case), [case]) for case in cases]
    return [_sound(given, cases)] * len(cases)


def fault_of(name: str, expected: Any, cases: Iterable[Case]) -> str:
    """Why the check `name` of `cases` cannot be expected to fail like this; "" if it can."""
    if name not in CHECKS:
        return f"there is no check `{name}`; {did_you_mean(str(name), CHECKS, 'checks')}"
    if not any(case.slot in CHECKS[name].slots for case in cases):
        slots = ", ".join(sorted(CHECKS[name].slots))
        return f"the check `{name}` applies to none of the cases, but to {slots}"
    if name in BASICS:
        return f"`{name}` cannot be expected to fail: the other checks would mean nothing"
    reason = expected.reason if isinstance(expected, ExpectedError) else expected
    if not (isinstance(reason, str) and reason.strip()):
        return f"the expected failure of `{name}` needs a reason"
    if isinstance(expected, ExpectedError) and not _is_narrow(expected.error):
        return f"the expected error of `{name}` is {expected.error!r}; name the class it is of"
    return ""


def is_expected(error: Exception, expected: Expected | None) -> bool:
    """Whether a check that ended with `error` failed as it is known to."""
    if isinstance(expected, ExpectedError):
        return isinstance(error, expected.error)
    return expected is not None and isinstance(error, ContractError)


def reason_of(expected: Expected) -> str:
    """Why the failure is right."""
    return expected.reason if isinstance(expected, ExpectedError) else expected


def _sound(given: Any, cases: Sequence[Case]) -> Mapping[str, Expected]:
    if not isinstance(given, Mapping):
        raise TypeError(
            f"the expected failures are no mapping but {described(given)}; "
            'write {"name_of_a_check": "the reason"}, or a function that gives it for a case'
        )
    for name, expected in given.items():
        fault = fault_of(name, expected, cases)
        if fault:
            raise ValueError(fault)
    return given


def _is_narrow(error: Any) -> bool:
    kinds = error if isinstance(error, tuple) else (error,)
    return bool(kinds) and all(
        isinstance(kind, type) and issubclass(kind, Exception) and kind is not Exception
        for kind in kinds
    )
