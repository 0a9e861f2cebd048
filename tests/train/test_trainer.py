"""Whole runs of tiny models on procedural rooms, and what they leave."""

from pathlib import Path
from unittest.mock import Mock

import torch
from PIL import Image
from qgs_viewer.curves import curves_of
from tables import assert_equal, assert_near, must_refuse, names_in
from training_runs import TRAINED, column, losses, parts_of, read_jsonl, resume, run, spoil, tiny

import qgs
from qgs.checkpoint.model_file import CheckpointFile
from qgs.contracts import TrainingConfig
from qgs.evaluate.evaluation import evaluate
from qgs.recipe import Recipe, resolve
from qgs.train.guard import NonFiniteError


def test_training_lowers_the_loss():
    recipe = tiny(
        "locus",
        "training={steps: 20, collapse_window: 10}",
        "optimizer={warmup: 4, learning_rate: 4.0e-3}",
        "data.scenes=1",
        "views.mirror=0.0",
    )
    run(recipe, device="auto")
    falling = losses()
    assert sum(falling[-5:]) < 0.95 * sum(falling[:5])


def test_a_run_leaves_recipe_history_and_checkpoint(trained_run):
    folder = trained_run.folder
    assert resolve(folder.recipe).tree == tiny("locus", TRAINED).tree
    history = folder.history()
    assert column(history, "step") == [1, 2, 3]
    assert {"psnr", "lr", "seconds", "gradient"} <= history[0].keys()
    assert CheckpointFile(folder.checkpoint).step == 3
    assert not trained_run.model.training
    assert_equal(qgs.load(folder.checkpoint).state_dict(), trained_run.model.state_dict())


def test_averages_and_evaluations_leave_the_training_alone(trained_run):
    plain = run(tiny("locus"))
    folder = trained_run.folder
    parts = parts_of()
    watched = parts_of(folder.path)
    for name in ("weights", "moments", "random"):
        assert_equal(parts[name], watched[name])
    assert losses() == losses(folder.path)
    start, average, last = (
        model.queries.features
        for model in (tiny("locus").build_model(), qgs.load(folder.checkpoint_ema), plain.model)
    )
    assert 0 < (average - last).norm() < (start - last).norm()  # it follows the weights


def test_weights_and_their_average_are_judged_and_shown_side_by_side(trained_run):
    folder = trained_run.folder
    recipe = tiny("locus", TRAINED)
    records = read_jsonl(folder.path / "evaluations.jsonl")
    told = [(r["step"], r["weights"], r["scenes"]) for r in records]
    assert told == [(step, weights, 2) for step in (2, 3) for weights in ("raw", "ema")]
    raw, average = (qgs.load(file) for file in (folder.checkpoint, folder.checkpoint_ema))
    scores = [evaluate(model, recipe).means() for model in (raw, average)]
    assert column(records[2:], "scores") == scores
    assert scores[0]["psnr"] != scores[1]["psnr"]
    pictures = folder.path / "pictures"
    assert names_in(pictures) == {"step-2.png", "step-3.png"}
    with Image.open(pictures / "step-3.png") as picture:
        assert picture.size == (56, 32)  # two rows of three, 4 apart


def test_scenes_that_do_not_split_evenly_are_refused():
    for processes, accumulate in ((3, 1), (1, 5), (8, 4)):
        config = TrainingConfig(batch_size=16, accumulate=accumulate)
        must_refuse(r"training\.batch_size: 16", config.scenes_per_batch, processes)


def test_bf16_trains_with_finite_numbers():
    model = run(tiny("locus", "training.precision=bf16")).model
    assert all(p.dtype == torch.float32 and p.isfinite().all() for p in model.parameters())


def test_a_time_budget_ends_the_run():
    recipe = tiny("tokengs", "training={steps: 200, seconds: 0.1}")
    result = run(recipe)
    assert 0.1 <= result.seconds < 10.0
    history = result.folder.history()
    assert 1 < result.steps == len(history) < 200
    clock = [0.0, *(record["seconds"] for record in history)]
    assert clock[1] == 0
    schedule = recipe.build_optimizer()
    for step, record in enumerate(history):
        assert_near(record["lr"], schedule.learning_rate(step, clock[step]))


def test_bad_steps_are_skipped_on_demand(monkeypatch, caplog):
    """By a run from its start, and by one that a bad step ended."""
    spoil(monkeypatch, {2, 6}, nan=True)
    options = "training={steps: 4, ema: 0.9}"
    skipping = tiny("locus", options, "training.on_nonfinite=skip")
    through = Path("through")
    run(skipping, through)
    told = [r.message.split(" is ")[0] for r in caplog.records if "is skipped" in r.message]
    assert told == ["step 2", "step 4"]
    records = read_jsonl(through / "history.jsonl")
    assert [("loss" in r, "skipped" in r) for r in records] == [(True, False), (False, True)] * 2
    assert column(curves_of(through / "checkpoint.safetensors"), "step") == [1, 3]
    assert parts_of(through)["guard"]["skipped"] == 1  # a good step lies between the two
    recipe = tiny("locus", options)
    for begin in (run, resume):
        told = str(must_refuse(r"targets\.images \(1 of", begin, recipe, kind=NonFiniteError))
        assert "step 2 has NaN or infinity" in told
        assert "mse is nan" in told
    assert len(losses()) == 1
    assert resume(skipping).resumed_at == 1
    ours = parts_of()
    theirs = parts_of(through)
    for name in ("weights", "ema"):
        assert_equal(ours[name], theirs[name])
        assert all(tensor.isfinite().all() for tensor in ours[name].values())


def test_a_bad_gradient_ends_the_run_too(monkeypatch):
    model = tiny("tokengs").build_model()
    next(model.parameters()).register_hook(lambda gradient: gradient * torch.inf)
    monkeypatch.setattr(Recipe, "build_model", Mock(return_value=model))
    must_refuse("the first bad tensor is gradient of", run, tiny("tokengs"), kind=NonFiniteError)
    assert not losses()


def test_skipping_comes_to_an_end(monkeypatch):
    spoil(monkeypatch, range(2, 100), nan=True)
    monkeypatch.setattr("qgs.train.guard.MAX_SKIPPED", 2)
    recipe = tiny("tokengs", "training={on_nonfinite: skip, steps: 50}")
    must_refuse("most 2 steps in a row", run, recipe, kind=NonFiniteError)
    assert len(read_jsonl(Path("run/history.jsonl"))) == 3
