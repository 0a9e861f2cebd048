"""Runs that die are noticed, said so, and leave good weights."""

from contextlib import closing
from pathlib import Path

import pytest
import torch
from training_runs import QUIET, Tiny, run_anywhere, run_calling

import qgs
from qgs.composer import Recipe
from qgs.contracts import TrainingConfig
from qgs.data.evaluation import evaluation_samples
from qgs.engine.distributed import StopRequest
from qgs.engine.folder import RunFolder
from qgs.engine.guard import (
    EMPTY_ALPHA,
    CollapseDetector,
    CollapseError,
    GoodWeights,
    broken_tensors,
    not_finite,
)
from qgs.engine.tracking import TrainingProgress
from qgs.engine.training import Trainer
from qgs.engine.training_pass import measure
from qgs.io.checkpoint import CheckpointFile

ALIVE = {"alpha": 0.5, "deviation": 0.3, "gradient": 0.1}
DEAD = dict.fromkeys(ALIVE, 0.0)
INVISIBLE = "model.head.opacity_bias=-20.0"


def observed(*signs: dict[str, float]) -> CollapseDetector:
    """A detector with a window of 10 steps, after steps with these signs of life."""
    detector = CollapseDetector(10)
    for step in signs:
        detector.observe(step)
    return detector


@pytest.mark.parametrize(
    ("dead", "words"),
    [
        ({"alpha": 1e-4}, "empty"),
        ({"gradient": 0.0}, "vanished"),
        ({"deviation": 1e-4}, "equal the background"),
    ],
)
def test_a_window_of_dead_steps_is_a_collapse(dead: dict[str, float], words: str) -> None:
    detector = observed(ALIVE, *[ALIVE | dead] * 9)
    assert not detector.dead_after(10)
    detector.observe(ALIVE | dead)
    assert detector.dead_after(10)
    assert words in detector.symptom


def test_one_living_step_starts_the_count_again() -> None:
    assert not observed(*[*[DEAD] * 9, ALIVE] * 5).dead_after(50)


def test_images_that_are_still_plain_at_the_start_are_no_collapse() -> None:
    assert not observed(*[ALIVE | {"deviation": 1e-4}] * 50).dead_after(50)


def test_good_weights_are_the_older_of_two_copies() -> None:
    module = torch.nn.Linear(2, 2)
    good = GoodWeights(module)
    for step in (10, 20, 30):
        torch.nn.init.constant_(module.weight, step)
        good.refresh(step)
    torch.nn.init.constant_(module.weight, 99)
    assert good.step == 20
    assert (good.tensors["weight"] == 20).all()


def test_what_is_not_finite_is_named() -> None:
    module = torch.nn.Linear(2, 2)
    assert not_finite({"mse": 1.0, "gradient": 0.5}, module) == ""
    assert "mse is nan" in not_finite({"mse": float("nan"), "gradient": 0.5}, module)
    module.weight.grad = torch.full((2, 2), torch.inf)
    module.bias.grad = torch.zeros(2)
    message = not_finite({"mse": 1.0, "gradient": float("inf")}, module)
    assert message.endswith("from weight")


def mean_alpha(checkpoint: Path, recipe: Recipe) -> float:
    model = qgs.load(checkpoint)
    sample = evaluation_samples(recipe.build_data(), recipe.views, recipe.evaluation)[0]
    with torch.no_grad():
        gaussians = model(sample.inputs).gaussians
        return float(model.render(gaussians, sample.targets.cameras).alpha.mean())


@pytest.mark.slow
def test_a_run_driven_to_the_background_stops_and_keeps_good_weights(
    tiny: Tiny, tmp_path: Path
) -> None:
    rising = ("warmup=150", "learning_rate=0.5", "initial_divisor=1e5")
    options = ("training.steps=300", "training.save_every=25")
    recipe = tiny("tokengs", *options, *(f"optimizer.{option}" for option in rising))
    assert recipe.training.collapse_window == TrainingConfig().collapse_window
    with pytest.raises(CollapseError) as caught:
        run_anywhere(recipe, tmp_path / "run")
    assert "checkpoint.safetensors" in str(caught.value)
    folder = RunFolder(tmp_path / "run")
    history = folder.history()
    kept = CheckpointFile(folder.checkpoint).step
    last_alive = max(record["step"] for record in history if record["alpha"] >= EMPTY_ALPHA)
    first_dead = min(record["step"] for record in history if record["alpha"] < EMPTY_ALPHA)
    assert last_alive < len(history) <= last_alive + 100 < 300
    assert first_dead - 50 < kept < first_dead
    assert mean_alpha(folder.checkpoint, recipe) > EMPTY_ALPHA


def test_gaussians_invisible_from_the_start_are_noticed_within_the_window(
    tiny: Tiny, tmp_path: Path
) -> None:
    options = ("training.steps=400", "training.collapse_window=20")
    with pytest.raises(CollapseError, match="renderings are empty"):
        run_anywhere(tiny("tokengs", INVISIBLE, *options), tmp_path / "run")
    history = RunFolder(tmp_path / "run").history()
    assert [record["step"] for record in history] == list(range(1, 21))


def test_no_copy_is_made_while_the_images_get_worse() -> None:
    good = GoodWeights(torch.nn.Linear(2, 2))
    for step in range(1, 101):
        good.observe({"psnr": 20.0 if step <= 60 else 10.0})
        if good.due(step, 50):
            good.refresh(step)
    assert good.state()["steps"] == [50, 60]
    assert not good.due(61, 50)


def test_a_run_that_ends_inside_a_collapse_fails_too(tiny: Tiny, tmp_path: Path) -> None:
    recipe = tiny("tokengs", INVISIBLE, "training.steps=12")
    with pytest.raises(CollapseError, match="for the last 12 steps"):
        run_anywhere(recipe, tmp_path / "run")


def test_nan_stops_at_once_with_finite_weights(tiny: Tiny, tmp_path: Path) -> None:
    trainer = Trainer(tiny("locus"), tmp_path / "run")
    with torch.no_grad():
        trainer.model.decoder[0].feed_forward_scale.gamma.fill_(torch.nan)
    with closing(trainer), pytest.raises(CollapseError, match=r"step 1: .*nan"):
        trainer.run(TrainingProgress(QUIET), StopRequest())
    model = qgs.load(trainer.folder.checkpoint)
    assert all(p.isfinite().all() for p in model.parameters())


def test_weights_that_are_not_finite_are_never_saved_as_good(tiny: Tiny, tmp_path: Path) -> None:
    def break_at_the_end(trainer: Trainer, stop: StopRequest) -> None:
        if trainer.step == 3:
            trainer.model.queries.features.data.fill_(torch.nan)

    with pytest.raises(CollapseError, match=r"weights are not finite: queries\.features"):
        run_calling(break_at_the_end, tiny("tokengs", "training.steps=3"), tmp_path / "run")
    assert broken_tensors(qgs.load(RunFolder(tmp_path / "run").checkpoint)) == ""


def test_one_dead_step_at_the_end_fails_no_run(
    tiny: Tiny, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    def die_at_the_end(trainer: Trainer, stop: StopRequest) -> None:
        if trainer.step == 3:
            trainer.guard.detector.observe(DEAD)

    result = run_calling(die_at_the_end, tiny("tokengs", "training.steps=3"), tmp_path / "run")
    assert CheckpointFile(result.folder.checkpoint).step == 3
    assert "for the last 1 steps" in caplog.text


def test_a_stray_splat_is_no_sign_of_life() -> None:
    background = torch.ones(3)
    rgb = torch.ones(2, 3, 3, 32, 32)
    rgb[0, 0, :, 4:6, 4:6] = 0
    alpha, deviation = measure(rgb, 1 - rgb[:, :, :1], background)
    assert alpha < EMPTY_ALPHA
    assert deviation == pytest.approx(4 / 32**2)
    symptom = observed(ALIVE, ALIVE | {"deviation": float(deviation)}).symptom
    assert "equal the background" in symptom
