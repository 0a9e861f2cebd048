"""Remarks on a refined reconstruction."""

from types import SimpleNamespace

import torch
from qgs_photos.refine.reconstruction import _worse_than_before

from qgs.reconstruction.result import ViewScore


def result(novel, side=8):
    """What the remark reads of a reconstruction: an input, and a compared photo at `novel` dB."""
    scores = [ViewScore(0, "input", 40.0), ViewScore(1, "novel", novel)]
    rendering = SimpleNamespace(rgb=torch.zeros(1, 2, 3, side, side))
    return SimpleNamespace(scores=scores, rendering=rendering)


def test_a_refinement_that_ended_too_early_is_remarked():
    assert "--seconds" in _worse_than_before(result(20.1), result(18.0))
    for before, after in (
        (result(18.0), result(20.1)),
        (result(20.104), result(20.101)),
        (result(20.1), result(18.0, side=16)),
    ):
        assert not _worse_than_before(before, after)
