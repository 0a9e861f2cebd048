"""What the shipped recipes promise of each other."""

from __future__ import annotations

from pathlib import Path

import pytest

from qgs.composer import resolve

RECIPES = Path(__file__).parents[1] / "recipes"


@pytest.mark.parametrize("pair", ["tiny/{}.yaml", "{}/re10k.yaml", "{}/dl3dv.yaml"])
def test_tokengs_and_locusgs_have_the_same_budget(pair: str) -> None:
    ours, theirs = (resolve(RECIPES / pair.format(name)) for name in ("tokengs", "locus"))
    for section in ("data", "views", "training", "evaluation"):
        assert ours.tree.get(section) == theirs.tree.get(section)
    for section in ("width", "heads", "encoder", "renderer"):
        assert ours.tree["model"][section] == theirs.tree["model"][section]
    first, second = ours.build_model("meta"), theirs.build_model("meta")
    assert first.queries.count == second.queries.count
    assert first.head.gaussians_per_query == second.head.gaussians_per_query
    assert first.depth == second.depth
    assert type(first.centers) is not type(second.centers)
