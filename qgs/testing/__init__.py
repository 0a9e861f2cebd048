"""The contract suite: checks that any component passes, or tells why not.

    from qgs.testing import Case, parametrize_with_checks

    @parametrize_with_checks([Case(MyAttention.Config())])
    def test_contract(check):
        check()

`qgs check-plugin NAME` makes the same checks of every component of an installed plugin.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from qgs.contracts import ExpectedError
    from qgs.testing.case import Case
    from qgs.testing.decorator import parametrize_with_checks
    from qgs.testing.faults import CannotCheck, ContractError
    from qgs.testing.plugins import cases_of, check_plugin
    from qgs.testing.registry import CHECKS, checks_for
    from qgs.testing.running import CaseRun, Outcome, run_check

__all__ = [
    "CHECKS",
    "CannotCheck",
    "Case",
    "CaseRun",
    "ContractError",
    "ExpectedError",
    "Outcome",
    "cases_of",
    "check_plugin",
    "checks_for",
    "parametrize_with_checks",
    "run_check",
]

_HOMES = {
    "Case": "qgs.testing.case",
    "parametrize_with_checks": "qgs.testing.decorator",
    "ExpectedError": "qgs.contracts",
    "CannotCheck": "qgs.testing.faults",
    "ContractError": "qgs.testing.faults",
    "cases_of": "qgs.testing.plugins",
    "check_plugin": "qgs.testing.plugins",
    "CHECKS": "qgs.testing.registry",
    "checks_for": "qgs.testing.registry",
    "CaseRun": "qgs.testing.running",
    "Outcome": "qgs.testing.running",
    "run_check": "qgs.testing.running",
}
"""Fetched on first use: another process imports `qgs.testing.serve` before any component."""


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if _HOMES[name] != "qgs.testing.faults":
        import_module("qgs.testing.checks")
    return getattr(import_module(_HOMES[name]), name)
