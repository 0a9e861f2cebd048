"""Components of DepthSplat keep their contracts."""

from qgs_mvsplat import DecayedSupervision, DepthSplatEncoder, Exchange, WorldHead
from qgs_plugintools import cases_of, parametrize_with_checks
from qgs_plugintools.plugins import exemptions_of

from qgs.composer.registry import load_plugin

OWN = (DepthSplatEncoder, WorldHead, Exchange, DecayedSupervision)
PLUGIN = load_plugin("mvsplat")
CASES = [case for case in cases_of(PLUGIN) if issubclass(case.component, OWN)]
EXEMPT = {
    case.label: found for case, found in zip(CASES, exemptions_of(PLUGIN, CASES), strict=True)
}


@parametrize_with_checks(CASES, expected_failures=lambda case: EXEMPT[case.label], tiers=["core"])
def test_contract(check) -> None:
    check()
