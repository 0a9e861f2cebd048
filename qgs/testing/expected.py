"""Failures that are known and stated with a reason."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, TypeAlias

from qgs.composer.errors import did_you_mean
from qgs.contracts import Expected, ExpectedError
from qgs.testing.case import Case
from qgs.testing.faults import ContractError
from qgs.testing.registry import BASICS, CHECKS
from qgs.testing.wording import named

ExpectedFailures: TypeAlias = Mapping[str, Expected] | Callable[[Case], Mapping[str, Expected]]
"""Check -> why it fails, for all cases, or as a function of the case."""


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


def expectation_fault(name: str, expected: Any, cases: Iterable[Case]) -> str:
    """Why the check `name` of `cases` cannot be expected to fail like this; "" if it can."""
    if name not in CHECKS:
        return f"there is no check `{name}`; {did_you_mean(str(name), CHECKS, 'checks')}"
    if not any(case.slot in CHECKS[name].slots for case in cases):
        slots = ", ".join(sorted(CHECKS[name].slots))
        return f"the check `{name}` applies to none of the cases, but to {slots}"
    if name in BASICS:
        return f"`{name}` cannot be expected to fail: the other checks would mean nothing"
    reason = expected.reason if isinstance(expected, ExpectedError) else expected
    if reason is not None and not isinstance(reason, str):
        return f"the expected failure of `{name}` is {named(reason)}; write the reason as a text"
    if not (reason and reason.strip()):
        return f"the expected failure of `{name}` needs a reason"
    return _error_fault(name, expected.error) if isinstance(expected, ExpectedError) else ""


def is_expected(error: BaseException, expected: Expected) -> bool:
    """Whether a check that ended with `error` failed as it is known to."""
    if isinstance(expected, ExpectedError):
        return isinstance(error, expected.error)
    return isinstance(error, ContractError)


def reason_of(expected: Expected) -> str:
    """Why the failure is right."""
    return expected.reason if isinstance(expected, ExpectedError) else expected


def _sound(given: Any, cases: Sequence[Case]) -> Mapping[str, Expected]:
    if not isinstance(given, Mapping):
        raise TypeError(
            f"the expected failures are no mapping but {named(given)}; "
            'write {"name_of_a_check": "the reason"}, or a function that gives it for a case'
        )
    for name, expected in given.items():
        fault = expectation_fault(name, expected, cases)
        if fault:
            raise ValueError(fault)
    return given


def _error_fault(name: str, error: Any) -> str:
    kinds = error if isinstance(error, tuple) else (error,)
    what = f"the expected error of `{name}` is {error!r}"
    if not kinds or not all(isinstance(k, type) and issubclass(k, Exception) for k in kinds):
        return f"{what}; name the class it is of"
    if Exception in kinds:
        return f"{what}, which every error is; name the class it is of"
    if any(issubclass(ContractError, k) or issubclass(k, ContractError) for k in kinds):
        return f"{what}, which a broken contract is too; give the reason alone, or another class"
    return ""
