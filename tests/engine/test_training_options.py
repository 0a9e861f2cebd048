"""Whole runs with the options of `training` that change what happens around a step."""

import json
import logging
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, get_args

import pytest
import torch
from qgs_viewer.curves import curves_of
from training_runs import (
    Tiny,
    change_batches,
    read_jsonl,
    run,
    same,
    tensorboard_events,
    weights,
)

import qgs
from qgs.composer import Recipe
from qgs.contracts import MissingExtraError, TrainingConfig
from qgs.data.samples import Batch
from qgs.engine import tracking as trackers
from qgs.engine.folder import read_state
from qgs.engine.guard import MAX_SKIPPED, NonFiniteError
from qgs.engine.precision import DTYPES


@pytest.fixture
def bad_batches(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """`bad_batches(2, 3)`: the training batches of these numbers, from 0, hold a NaN pixel."""

    def spoil(*numbers: int) -> None:
        def spoiled(batch: Batch, samples: Sequence[int]) -> None:
            if samples[0] // len(samples) in numbers:
                batch.targets.images[0, 0, 0, 0, 0] = torch.nan

        change_batches(monkeypatch, spoiled)

    return spoil


def test_the_average_is_saved_and_judged_at_the_end(tiny: Tiny, tmp_path: Path) -> None:
    plain = run(tiny("locus"), tmp_path / "plain")
    averaged = run(tiny("locus", "training.ema=0.5"), tmp_path / "ema")
    assert same(weights(plain), weights(averaged))
    folder = averaged.folder
    average = qgs.load(folder.checkpoint_ema).state_dict()
    assert average.keys() == weights(plain).keys()
    assert not same(average, weights(plain))
    largest = max(float((average[n] - t).abs().max()) for n, t in weights(plain).items())
    assert largest < 0.1, "near the weights it follows"
    records = read_jsonl(folder.path / "evaluations.jsonl")
    assert [(r["step"], r["weights"]) for r in records] == [(4, "raw"), (4, "ema")]
    assert not plain.folder.checkpoint_ema.exists()


def test_evaluations_do_not_touch_the_training(tiny: Tiny, tmp_path: Path) -> None:
    plain = run(tiny("locus"), tmp_path / "plain")
    watched = run(tiny("locus", "training.evaluate_every=2"), tmp_path / "watched")
    assert same(weights(plain), weights(watched))
    losses = [[r["loss"] for r in result.folder.history()] for result in (plain, watched)]
    assert losses[0] == losses[1]
    folder = watched.folder.path
    assert [record["step"] for record in read_jsonl(folder / "evaluations.jsonl")] == [2, 4]
    assert {p.name for p in (folder / "pictures").iterdir()} == {"step-2.png", "step-4.png"}


def test_a_bad_step_ends_the_run_before_the_optimiser(
    tiny: Tiny, tmp_path: Path, bad_batches: Callable[..., None]
) -> None:
    bad_batches(2)
    folder = tmp_path / "run"
    with pytest.raises(NonFiniteError, match=r"targets\.images \(1 NaN of") as error:
        run(tiny("tokengs"), folder)
    incident = folder / "incidents" / "step-3"
    assert str(incident) in str(error.value)
    assert [record["step"] for record in read_jsonl(folder / "history.jsonl")] == [1, 2]
    saved = qgs.load(incident / "weights.safetensors").state_dict()
    assert all(tensor.isfinite().all() for tensor in saved.values())
    report = json.loads((incident / "report.json").read_text())
    shown = report["found"][0]["batches"][0]
    assert f"scene {shown['scenes'][0]!r}" in str(error.value)
    assert str(shown["target_frames"][0]) in str(error.value)
    assert report["step"] == 3
    assert "mse is nan" in report["symptom"]


def test_a_bad_gradient_ends_the_run_too(
    tiny: Tiny, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    build = Recipe.build_model

    def poisoned(recipe: Recipe, device: Any = None, **options: Any) -> Any:
        model = build(recipe, device, **options)
        parameter = next(model.parameters())
        parameter.register_hook(lambda gradient: gradient * float("inf"))
        return model

    monkeypatch.setattr(Recipe, "build_model", poisoned)
    with pytest.raises(NonFiniteError, match="the first bad tensor is gradient of"):
        run(tiny("tokengs"), tmp_path / "run")
    assert not (tmp_path / "run" / "history.jsonl").exists()


def test_a_bad_step_is_skipped_on_demand(
    tiny: Tiny,
    tmp_path: Path,
    bad_batches: Callable[..., None],
    caplog: pytest.LogCaptureFixture,
) -> None:
    bad_batches(1, 3)
    recipe = tiny("tokengs", "training.on_nonfinite=skip", "training.ema=0.9")
    with caplog.at_level(logging.WARNING):
        result = run(recipe, tmp_path / "run")
    assert result.steps == 4
    told = [r.message for r in caplog.records if "is skipped" in r.message]
    assert [message.split(" is skipped")[0] for message in told] == ["step 2", "step 4"]
    folder = result.folder.path
    records = read_jsonl(folder / "history.jsonl")
    assert [record["step"] for record in records] == [1, 2, 3, 4]
    assert ["loss" in record for record in records] == [True, False, True, False]
    assert [record.get("skipped", False) for record in records] == [False, True, False, True]
    curves = curves_of(result.folder.checkpoint)
    assert curves is not None
    assert curves.steps == [1, 3]
    assert {p.name for p in (folder / "incidents").iterdir()} == {"step-2", "step-4"}
    counted = read_state(folder / "state.safetensors").parts["guard"]
    assert (counted["incidents"], counted["skipped"]) == (2, 1), "a good step lies between the two"
    for file in (result.folder.checkpoint, result.folder.checkpoint_ema):
        assert all(tensor.isfinite().all() for tensor in qgs.load(file).state_dict().values())


def test_a_run_that_a_bad_step_ended_goes_on_without_it(
    tiny: Tiny, tmp_path: Path, bad_batches: Callable[..., None]
) -> None:
    bad_batches(2)
    options = ("training.steps=6", "training.ema=0.9", "training.save_every=4")
    skipping = tiny("locus", *options, "training.on_nonfinite=skip")
    through = run(skipping, tmp_path / "through")
    stopping = tiny("locus", *options)
    with pytest.raises(NonFiniteError, match="step 3 is not finite"):
        run(stopping, tmp_path / "stopped")
    with pytest.raises(NonFiniteError, match="step 3 is not finite"):
        run(stopping, tmp_path / "stopped", resume=True)
    again = run(skipping, tmp_path / "stopped", resume=True)
    assert again.resumed_at == 2
    assert same(weights(again), weights(through))
    averages = [qgs.load(r.folder.checkpoint_ema).state_dict() for r in (again, through)]
    assert same(*averages)


def test_skipping_comes_to_an_end(
    tiny: Tiny, tmp_path: Path, bad_batches: Callable[..., None]
) -> None:
    bad_batches(*range(1, 100))
    recipe = tiny("tokengs", "training.on_nonfinite=skip", "training.steps=50")
    with pytest.raises(NonFiniteError, match=f"{MAX_SKIPPED} steps in a row were skipped"):
        run(recipe, tmp_path / "run")
    steps = [record["step"] for record in read_jsonl(tmp_path / "run" / "history.jsonl")]
    assert steps == list(range(1, MAX_SKIPPED + 2))


def test_a_missing_tracker_is_told_before_anything_is_made(
    tiny: Tiny, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trackers, "find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match=r"query-gaussians\[tensorboard\]"):
        run(tiny("tokengs", "training.trackers=[tensorboard]"), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_tensorboard_gets_what_the_history_gets(tiny: Tiny, tmp_path: Path) -> None:
    pytest.importorskip("tensorboard", reason="the extra `tensorboard` is not installed")
    options = ("training.trackers=[tensorboard]", "training.evaluate_every=4")
    result = run(tiny("locus", *options), tmp_path / "run")
    events = tensorboard_events(tmp_path / "run")
    for name in ("loss", "psnr", "lr"):
        told = [event.value for event in events.Scalars(name)]
        assert told == pytest.approx([record[name] for record in result.folder.history()])
    (judged,) = events.Scalars("evaluation/raw/psnr")
    assert judged.step == 4
    assert len(events.Images("evaluation")) == 1


def test_every_precision_of_a_recipe_has_its_dtype() -> None:
    assert get_args(TrainingConfig.model_fields["precision"].annotation) == tuple(DTYPES)
