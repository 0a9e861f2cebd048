"""What models and containers look like when printed."""

import re

import pytest

import qgs

SMALL = {
    "recipe": 1,
    "plugins": ["locus"],
    "model": {
        "width": 32,
        "heads": 2,
        "queries": {"type": "locus/anchored", "count": 8},
        "decoder": {
            "depth": 2,
            "layers": {"1": {"cross_attention": {"type": "locus/ray_biased"}}},
        },
        "head": {"gaussians_per_query": 4},
        "supervision": {"layers": [2]},
    },
}


@pytest.fixture(scope="module")
def model():
    return qgs.compose(SMALL).eval()


def test_a_model_says_its_slots_in_a_few_lines(model):
    heading, *lines = repr(model).splitlines()
    total = sum(parameter.numel() for parameter in model.parameters())
    assert f"{total:,} parameters" in heading
    assert "8 queries of 4 Gaussians" in heading
    assert len(lines) == 12
    assert re.search(
        r"^  decoder\.cross_attention +qgs/content, locus/ray_biased +[\d,]+$", repr(model), re.M
    )
    counts = [int(line.split()[-1].replace(",", "")) for line in lines[:10]]
    assert sum(counts) == total
    for word in ("locus/anchored", "qgs/gaussian_head", "qgs/auto"):
        assert word in repr(model)
