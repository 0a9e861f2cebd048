"""MVSplat's components keep their contracts, as `qgs check-plugin mvsplat` says too."""

import json
from dataclasses import replace
from pathlib import Path

from qgs_mvsplat.head import RayHead
from qgs_mvsplat.mvsplat import MVSplatEncoder
from qgs_mvsplat.pixels import OnRays, PixelQueries
from qgs_plugintools import cases_of, parametrize_with_checks
from qgs_plugintools.plugins import exemptions_of

from qgs.composer.registry import load_plugin

OURS = (MVSplatEncoder, PixelQueries, RayHead, OnRays)
SNAPSHOT = json.loads((Path(__file__).parent / "mvsplat_state_dicts.json").read_text())
"""Label of a case -> name -> shape in its state dict, so that saved weights stay loadable."""

PLUGIN = load_plugin("mvsplat")
ALL = cases_of(PLUGIN)
EXEMPTIONS = {
    case.label: found for case, found in zip(ALL, exemptions_of(PLUGIN, ALL), strict=True)
}
CASES = [
    replace(case, state_dict=SNAPSHOT.get(case.label))
    for case in ALL
    if issubclass(case.component, OURS)
]


def test_state_dicts_of_all_cases_are_pinned_and_no_others() -> None:
    assert SNAPSHOT.keys() == {case.label for case in CASES if case.build().state_dict()}


@parametrize_with_checks(
    CASES, expected_failures=lambda case: EXEMPTIONS[case.label], tiers=["core"]
)
def test_contract(check) -> None:
    check()
