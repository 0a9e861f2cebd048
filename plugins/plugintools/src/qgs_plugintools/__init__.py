"""The contract suite: checks that every component of a slot must pass.

    from qgs_plugintools import Case, parametrize_with_checks

    @parametrize_with_checks([Case(MyAttention.Config())])
    def test_contract(check):
        check()

`qgs check-plugin NAME` runs the same checks on every component of an installed plugin.
"""

import qgs_plugintools.checks  # noqa: F401  (registers the checks)
from qgs_plugintools.case import CannotCheck, Case, ContractError
from qgs_plugintools.plugins import cases_of, check_plugin
from qgs_plugintools.registry import CHECKS, checks_for
from qgs_plugintools.running import CaseRun, CheckResult, parametrize_with_checks, run_check

__all__ = [
    "CHECKS",
    "CannotCheck",
    "Case",
    "CaseRun",
    "CheckResult",
    "ContractError",
    "cases_of",
    "check_plugin",
    "checks_for",
    "parametrize_with_checks",
    "run_check",
]
