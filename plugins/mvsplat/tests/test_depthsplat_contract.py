"""Components of DepthSplat keep their contracts."""

from qgs_mvsplat import DecayedSupervision, DepthSplatEncoder, Exchange, WorldHead
from qgs_plugintools import cases_of, parametrize_with_checks
from qgs_plugintools.plugins import exemptions_of

from qgs.composer.registry import load_plugin

OWN = (DepthSplatEncoder, WorldHead, Exchange, DecayedSupervision)
PLUGIN = load_plugin("mvsplat")
ALL = cases_of(PLUGIN)
KNOWN = dict(zip([case.label for case in ALL], exemptions_of(PLUGIN, ALL), strict=True))
CASES = [case for case in ALL if issubclass(case.component, OWN)]


@parametrize_with_checks(CASES, expected_failures=lambda case: KNOWN[case.label], tiers=["core"])
def test_contract(check) -> None:
    check()
