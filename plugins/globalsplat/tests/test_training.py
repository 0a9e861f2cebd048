"""Trainings of a few steps: two passes, a level that grows, views that are too few."""

from pathlib import Path

import pytest

import qgs
from qgs.composer import Recipe, RecipeError, resolve
from qgs.engine.training import train

TINY = Path(__file__).parents[3] / "recipes" / "tiny" / "globalsplat.yaml"

SMALL = (
    *("model.width=32", "model.heads=2", "model.decoder.depth=1", "model.supervision.layers=[1]"),
    *("model.queries.count=24", "data.image_size=[16, 16]", "optimizer.warmup=2"),
    *("training.steps=6", "training.seconds=null", "evaluation.scenes=2"),
)
TWO = "objective={type: globalsplat/two_passes}"
GROWING = "model.head.level={schedule: steps, values: [0, 0.5, 1, 3], at: [1, 2, 4]}"


def small(*overrides: str) -> Recipe:
    return resolve(TINY, [*SMALL, *overrides])


def test_two_passes_train_and_their_terms_are_recorded(tmp_path: Path) -> None:
    result = train(small(TWO, "views.inputs=4", GROWING), tmp_path / "run", device="cpu")
    history = result.folder.history()
    assert len(history) > 1
    for record in history:
        assert record["alpha_consistency"] > 0
        assert record["depth_consistency"] > 0
        assert record.keys() >= {"mse", "frustum"}
    model = qgs.load(result.folder.checkpoint)
    assert model.head.gaussians_per_query == 8  # those of the last step
    assert qgs.compose(TINY, overrides=[GROWING]).head.gaussians_per_query == 1  # of the first one


def test_two_views_are_refused_with_the_reason() -> None:
    with pytest.raises(RecipeError, match=r"(?s)at least 3 input views, got 2.*raise views.inputs"):
        small(TWO)
