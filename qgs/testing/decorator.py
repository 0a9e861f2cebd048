"""The contract suite as pytest tests."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from qgs.contracts import CONTRACT_VERSION
from qgs.testing.case import Case
from qgs.testing.registry import Check, Tier, checks_for
from qgs.testing.running import refuse_unknown, run_check


@dataclass(frozen=True)
class BoundCheck:
    """A check of a case, made by calling it inside a pytest test."""

    check: Check
    case: Case
    expected: str | None = None

    def __call__(self) -> None:
        """Pass, or end the running pytest test as failed, skipped or expected to fail."""
        import pytest

        outcome = run_check(self.check, self.case, self.expected)
        if outcome.verdict == "skipped":
            pytest.skip(outcome.message)
        if outcome.verdict == "expected failure":
            pytest.xfail(outcome.message)
        if not outcome.ok:
            pytest.fail(outcome.message, pytrace=False)


def parametrize_with_checks(
    cases: Iterable[Case],
    *,
    expected_failures: Mapping[str, str] | None = None,
    tiers: Iterable[Tier] = ("core", "extended"),
    contract_version: int = CONTRACT_VERSION,
) -> Callable[[Callable[..., Any]], Any]:
    """Parametrise a pytest test with every check that applies to each case.

        @parametrize_with_checks([Case(MyAttention.Config())])
        def test_contract(check):
            check()

    expected_failures: check -> why the cases fail it. Strict: one that passes is a failure.
    tiers: "core", "extended". contract_version: what the components were written for.
    Raises ValueError for no cases, for expected failures that no check can be, and for another
    contract version than the installed one.
    """
    import pytest

    chosen, wanted = list(cases), tuple(tiers)
    expected = dict(expected_failures or {})
    if not chosen:
        raise ValueError("there are no cases to check; give Case(MyComponent.Config())")
    if contract_version != CONTRACT_VERSION:
        raise ValueError(
            f"these tests are of contract version {contract_version}, this qgs has version "
            f"{CONTRACT_VERSION}; install the qgs they were written for, or bring them up to date"
        )
    refuse_unknown(expected, chosen)
    parameters = [
        pytest.param(BoundCheck(c, case, expected.get(c.name)), id=f"{case.label}-{c.name}")
        for case in chosen
        for c in checks_for(case, wanted)
    ]
    return pytest.mark.parametrize("check", parameters)
