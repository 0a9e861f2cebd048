"""Every component keeps its contract, as `qgs check-plugin ellipsoid` says too."""

from __future__ import annotations

from qgs.composer.registry import load_plugin
from qgs.testing import cases_of, parametrize_with_checks


@parametrize_with_checks(cases_of(load_plugin("ellipsoid")), tiers=["core"])
def test_contract(check):
    check()
