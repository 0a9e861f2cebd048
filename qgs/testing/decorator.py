"""The contract suite as pytest tests."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from importlib import import_module
from types import ModuleType
from typing import Any

from qgs.contracts import CONTRACT_VERSION, ComponentConfig
from qgs.contracts.component import MissingExtraError
from qgs.testing.case import Case
from qgs.testing.expected import ExpectedFailures, expected_of
from qgs.testing.registry import TIERS, Check, Tier, case_given, checks_for, tiers_given
from qgs.testing.running import CaseRun
from qgs.testing.wording import case_of, named


@dataclass(frozen=True)
class BoundCheck:
    """A check of a case, made by calling it inside a pytest test."""

    check: Check
    run: CaseRun

    def __call__(self) -> None:
        """Pass, or end the running pytest test as failed, skipped or expected to fail."""
        import pytest

        outcome = self.run.make(self.check)
        if outcome.verdict == "skipped":
            pytest.skip(outcome.message)
        if outcome.verdict == "expected failure":
            pytest.xfail(outcome.message)
        if not outcome.ok:
            pytest.fail(outcome.message, pytrace=False)


def parametrize_with_checks(
    cases: Iterable[Case],
    *,
    expected_failures: ExpectedFailures | None = None,
    tiers: Iterable[Tier] = TIERS,
    contract_version: int = CONTRACT_VERSION,
) -> Callable[[Callable[..., Any]], Any]:
    """Parametrise a pytest test with every check that applies to each case.

        @parametrize_with_checks([Case(MyAttention.Config())])
        def test_contract(check):
            check()

    expected_failures: check -> why the cases fail it, or a function that gives that for a case.
        Strict: a check that passes is a failure. A reason stands for a check that sees the contract
        broken; for one that ends with an error, write `ExpectedError(ItsClass, reason)`.
    tiers: "core", "extended". contract_version: what the components were written for.
    Raises TypeError for what is no list of cases, no expected failures or no contract version;
    ValueError for no cases, for no tiers or unknown ones, for expected failures that no check can
    be, and for another contract version than the installed one; MissingExtraError without pytest.
    """
    pytest = _pytest()
    chosen, wanted = cases_given(cases), tiers_given(tiers)
    if type(contract_version) is not int:
        raise TypeError(
            f"contract_version is {named(contract_version)}; write it as a number, such as "
            f"contract_version={CONTRACT_VERSION}"
        )
    if contract_version != CONTRACT_VERSION:
        raise ValueError(
            f"these tests are of contract version {contract_version}, this qgs has version "
            f"{CONTRACT_VERSION}; install the qgs they were written for, or bring them up to date"
        )
    runs = [
        CaseRun(case, expected)
        for case, expected in zip(chosen, expected_of(expected_failures, chosen), strict=True)
    ]
    parameters = [
        pytest.param(BoundCheck(check, run), id=f"{run.case.label}-{check.name}")
        for run in runs
        for check in checks_for(run.case, wanted)
    ]
    return pytest.mark.parametrize("check", parameters)


def _pytest() -> ModuleType:
    try:
        return import_module("pytest")
    except ModuleNotFoundError as error:
        raise MissingExtraError(
            "parametrize_with_checks needs pytest, which is not installed: run `pip install "
            "pytest`, or make the checks with `qgs check-plugin` or qgs.testing.run_check"
        ) from error


def cases_given(given: Iterable[Case]) -> list[Case]:
    """At least one case; raises TypeError for what is none, ValueError where there are none."""
    if isinstance(given, Case):
        raise TypeError(f"the cases are no list but the one case {given.label}; give [Case(...)]")
    single = inspect.isclass(given) or isinstance(given, str | ComponentConfig)
    if single or not isinstance(given, Iterable):
        raise TypeError(f"the cases are no list but {named(given)}; give [{case_of(given)}]")
    cases = list(given)
    for case in cases:
        case_given(case)
    if not cases:
        raise ValueError("there are no cases to check; give [Case(MyComponent.Config())]")
    return cases
