"""Every component of the framework and of LocusGS keeps its contract."""

from __future__ import annotations

import pytest

from qgs.components import FreeCenters
from qgs.composer.registry import load_plugin
from qgs.testing import Case, cases_of, parametrize_with_checks

BUILT_IN = cases_of(load_plugin("qgs"))
LOCUS = cases_of(load_plugin("locus"))

TOKENGS_CENTERS = FreeCenters.Config(input_limit=None, output_limit=None)


@parametrize_with_checks([*BUILT_IN, *LOCUS], tiers=["core"])
def test_contract(check):
    check()


@pytest.mark.slow
@parametrize_with_checks([*BUILT_IN, *LOCUS], tiers=["extended"])
def test_extended_contract(check):
    check()


@parametrize_with_checks(
    [Case(TOKENGS_CENTERS)],
    expected_failures={
        "large_numbers_stay_finite": "TokenGS as published places Gaussians at exp|t|, unbounded"
    },
    tiers=["core"],
)
def test_contract_of_tokengs_as_published(check):
    check()
