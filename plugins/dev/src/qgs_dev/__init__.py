"""Contract suite for components: checks that every component of a slot must pass.

    import pytest
    from qgs_dev import runs_of

    @pytest.mark.parametrize("run", runs_of("sightline"), ids=str)
    def test_contract(run):
        run.check()

`qgs check-plugin sightline` runs the same checks of the plugin `sightline` and prints a report.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from qgs_dev.case import CannotCheck, Case, ContractError
    from qgs_dev.running import (
        CHECKS,
        CaseRun,
        CheckResult,
        cases_of,
        check_plugin,
        checks_for,
        run_check,
        runs_of,
    )

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
    "run_check",
    "runs_of",
]


def __getattr__(name: str) -> Any:
    """Import a public name on first use, so that `--help` imports neither torch nor pydantic."""
    if name not in __all__:
        raise AttributeError(f"module 'qgs_dev' has no attribute {name!r}")
    # `running` also imports the public names of the other modules.
    return getattr(import_module("qgs_dev.running"), name)
