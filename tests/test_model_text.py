"""What models look like when printed."""

import re

from training_runs import tiny

LAYER = "model.decoder.layers={0: {cross_attention: {type: qgs/content}}}"


def test_a_model_says_its_slots_in_a_few_lines():
    model = tiny("locus", LAYER).build_model()
    heading, *lines = repr(model).splitlines()
    total = sum(parameter.numel() for parameter in model.parameters())
    assert f"{total:,} parameters" in heading
    assert "24 queries of 4 Gaussians" in heading
    cells = r"^  decoder\.cross_attention +qgs/content, locus/ray_biased +[\d,]+$"
    assert re.search(cells, repr(model), re.M)
    assert sum(int(line.split()[-1].replace(",", "")) for line in lines[:10]) == total
