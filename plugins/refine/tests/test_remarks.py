"""Remarks on a refined reconstruction."""

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from qgs_refine.reconstruction import _worse_than_before

from qgs.analysis.reconstruction import ViewScore


def result(novel: float, side: int = 8) -> Any:
    """What the remark reads of a reconstruction: an input, and a compared photo at `novel` dB."""
    scores = [ViewScore(0, "input", 40.0), ViewScore(1, "novel", novel)]
    return SimpleNamespace(
        scores=scores, rendering=SimpleNamespace(rgb=torch.zeros(1, 2, 3, side, side))
    )


@pytest.mark.parametrize(
    ("before", "after", "remarked"),
    [
        (result(20.1), result(18.0), True),
        (result(18.0), result(20.1), False),
        (result(20.104), result(20.101), False),
        (result(20.1), result(18.0, side=16), False),
    ],
)
def test_a_refinement_that_ended_too_early_is_remarked(before, after, remarked) -> None:
    assert ("--refine" in _worse_than_before(before, after)) == remarked
