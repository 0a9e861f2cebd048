"""Evaluation: the same twice, equal to the metrics it is made of, and nothing left out unsaid."""

import csv
import hashlib
import io
import json
import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain, repeat
from pathlib import Path

import pytest
import torch
from photo_formats import synthetic, write_nerfstudio
from qgs_rooms.source import RoomsSource
from rich.console import Console
from training_runs import Tiny, same

from qgs.composer import Recipe
from qgs.contracts import Scene
from qgs.data.evaluation import evaluation_samples
from qgs.data.samples import Sample
from qgs.engine.evaluation import evaluate
from qgs.engine.results import METHODS, Evaluation
from qgs.metrics.baselines import mean_colour, nearest_input
from qgs.metrics.dispersion import token_dispersion
from qgs.metrics.images import Psnr, psnr, ssim

FILES = ["protocol.json", "scenes.csv", "summary.json", "table.md"]


def write_index(folder: Path, **scenes: tuple[Sequence[int], Sequence[int]] | None) -> str:
    file = folder / "some_index.json"
    names = (name.replace("room", "test/00000") for name in scenes)
    entries = [f and {"context": f[0], "target": f[1]} for f in scenes.values()]
    file.write_text(json.dumps(dict(zip(names, entries, strict=True))))
    return f"evaluation.index={file}"


def first_sample(recipe: Recipe) -> Sample:
    return evaluation_samples(recipe.build_data(), recipe.views, recipe.evaluation)[0]


def shown(evaluation: Evaluation) -> str:
    console = Console(record=True, width=100, file=io.StringIO())
    evaluation.show(console)
    return console.export_text()


def test_twice_gives_the_same_files_from_data_opened_once(
    tiny: Tiny, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recipe = tiny("locus", "evaluation.protocol=rooms-2view")
    opened: list[RoomsSource] = []
    scenes = RoomsSource.scenes
    monkeypatch.setattr(
        RoomsSource, "scenes", lambda self, split: opened.append(self) or scenes(self, split)
    )
    for name in ("a", "b"):
        model = recipe.build_model().train()
        evaluate(model, recipe).write(tmp_path / name)
        assert model.training
    assert len({id(source) for source in opened}) == 2
    assert sorted(path.name for path in (tmp_path / "a").iterdir()) == FILES
    for file in FILES:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()
    told = json.loads((tmp_path / "a" / "summary.json").read_text())["protocol"]
    assert told["name"] == "rooms-2view"
    content = (tmp_path / "a" / "protocol.json").read_bytes()
    assert hashlib.sha256(content).hexdigest() == told["sha256"]


def test_scores_hold_the_metrics_of_model_and_baselines(tiny: Tiny, tmp_path: Path) -> None:
    recipe = tiny("tokengs")
    model = recipe.build_model().eval()
    evaluation = evaluate(model, recipe)
    sample = first_sample(recipe)
    cameras, truth = sample.targets.cameras, sample.targets.images
    with torch.no_grad():
        gaussians = model(sample.inputs).gaussians
        rgb = model.render(gaussians, cameras).rgb
    images = {
        "model": rgb,
        "nearest_input": nearest_input(sample.inputs, cameras),
        "mean_colour": mean_colour(sample.inputs, cameras),
    }
    score = evaluation.scores[0]
    assert score.views == [(sample.input_frames, sample.target_frames)]
    for method, image in images.items():
        for name, metric in (("psnr", psnr), ("ssim", ssim)):
            expected = float(metric(image, truth).mean())
            assert score.values[f"{method}_{name}"] == pytest.approx(expected, rel=1e-6)
    dispersion = float(token_dispersion(gaussians.means, 4).mean())
    assert score.values["model_dispersion_mean"] == pytest.approx(dispersion, rel=1e-6)
    assert score.values["gaussians_used"] == int((gaussians.opacities > 1 / 255).sum())

    evaluation.write(tmp_path)
    summary = json.loads((tmp_path / "summary.json").read_text())
    rows = list(csv.DictReader((tmp_path / "scenes.csv").open()))
    assert [row["scene"] for row in rows] == ["test/000000", "test/000001"]
    assert summary["scenes"] == summary["samples"] == len(rows) == 2
    assert summary["gaussians"] == gaussians.count
    for method in METHODS:
        mean = sum(float(r[f"{method}_psnr"]) for r in rows) / len(rows)
        assert summary[method]["psnr"] == pytest.approx(mean)
        assert (summary[method]["dispersion_mean"] is None) == (method != "model")


def assert_batches_change_no_score(recipe: Recipe, batch: int) -> list[tuple[int, ...]]:
    """Scenes and views of each pass of the model under `batch`."""
    model = recipe.build_model()
    alone = evaluate(model, recipe)
    sizes: list[tuple[int, ...]] = []
    model.encoder.register_forward_pre_hook(
        lambda module, arguments: sizes.append(tuple(arguments[0].images.shape[:2]))
    )
    together = evaluate(model, recipe, batch=batch)
    for ours, theirs in zip(together.scores, alone.scores, strict=True):
        assert (ours.scene, ours.views) == (theirs.scene, theirs.views)
        assert ours.values == pytest.approx(theirs.values, rel=0, abs=1e-6)
    return sizes


@pytest.mark.parametrize(("name", "batch"), [("tokengs", 4), ("locus", 16)])
def test_batches_change_no_score(tiny: Tiny, name: str, batch: int) -> None:
    recipe = tiny(name, "evaluation.scenes=3", "evaluation.samples=2")
    assert_batches_change_no_score(recipe, batch)


def test_batches_pass_through_the_model_together(tiny: Tiny, tmp_path: Path) -> None:
    frames = {"room0": ([0, 4], [2]), "room1": ([0, 4], [1, 2, 3])}
    index = write_index(tmp_path, **frames, room2=([0, 2, 4], [1]), room3=([1], [2]))
    sizes = assert_batches_change_no_score(tiny("tokengs", index), 4)
    assert sizes == [(2, 2), (1, 3), (1, 1)]


def test_what_is_missing_is_told_in_the_same_line_as_the_score(tiny: Tiny, tmp_path: Path) -> None:
    index = write_index(
        tmp_path, room0=([0, 3], [1, 2]), room1=([0, 99], [1]), gone=([0, 3], [1]), nil=None
    )
    evaluation = evaluate((recipe := tiny("tokengs", index)).build_model(), recipe)
    assert evaluation.wanted == ("test/000000", "test/000001", "gone")
    summary = evaluation.summary()
    assert summary["missing"] == {
        "test/000001": "the index names frames 99, the scene has 0 to 7",
        "gone": "not among the test scenes of the data",
    }
    assert (summary["scenes"], summary["scenes_in_protocol"]) == (1, 3)
    assert summary["null_entries"] == ["nil"]
    assert len(summary["not_in_index"]) == 30
    evaluation.write(tmp_path)
    whole = replace(evaluation, wanted=evaluation.wanted[:1], missing=())
    assert whole.summary()["statement"].endswith(" over 1 scene")
    assert "input views of 16 x 16 pixels, poses" in shown(evaluation)
    line = f"PSNR {summary['model']['psnr']:.2f} over 1 of 3 scenes; missing: test/000001, gone"
    table = (tmp_path / "table.md").read_text()
    for text in (shown(evaluation), table, summary["statement"]):
        assert line in text
    assert all("1 of 3" in row for row in table.splitlines() if row.startswith("| model"))
    assert "null entries of the index, not judged (1): nil" in table
    rows = {row["scene"]: row for row in csv.DictReader((tmp_path / "scenes.csv").open())}
    assert list(rows) == ["test/000000", "test/000001", "gone"]
    assert rows["gone"]["problem"] == "not among the test scenes of the data"
    assert rows["test/000000"]["input_frames"] == "0 3"
    assert rows["test/000000"]["problem"] == ""


def test_a_failure_anywhere_ends_neither_evaluation_nor_in_silence(
    tiny: Tiny, monkeypatch: pytest.MonkeyPatch
) -> None:
    recipe = tiny("tokengs", "evaluation.scenes=4")
    model, forward = recipe.build_model(), type(recipe.build_model().encoder).forward
    rooms = recipe.build_data().scenes("test")
    victim, blank, broken = (rooms[number] for number in range(3))
    photo = victim.images([0])[0]
    images = type(victim).images

    def decoded(scene: Scene, frames: Sequence[int]) -> torch.Tensor:
        if scene.name == broken.name:
            raise OSError("/data/set/truncated.png is cut off")
        found = images(scene, frames)
        return torch.full_like(found, math.nan) if scene.name == blank.name else found

    def encoded(self, views):
        if any(torch.equal(image, photo) for scene in views.images for image in scene):
            raise RuntimeError("out of memory")
        return forward(self, views)

    monkeypatch.setattr(type(victim), "images", decoded)
    monkeypatch.setattr(type(model.encoder), "forward", encoded)
    monkeypatch.setattr("qgs.data.view_samplers.Span.draw", lambda *_: ((0, 3), (1, 2)))
    evaluation = evaluate(model, recipe, batch=4)
    assert [score.scene for score in evaluation.scores] == ["test/000003"]
    reasons = [failure.reason for failure in evaluation.missing]
    assert reasons[0] == "RuntimeError: out of memory"
    assert "is not finite" in reasons[1]
    assert reasons[2] == "OSError: /data/set/truncated.png is cut off"


def test_photo_folders_are_judged_on_held_out_frames_beside_a_broken_one(
    tiny: Tiny, tmp_path: Path
) -> None:
    for name in ("a", "b", "c"):
        write_nerfstudio(tmp_path / "set" / name, synthetic(tmp_path / "photos", 12, (32, 32)))
    (tmp_path / "set" / "b" / "transforms.json").write_text("{")
    (tmp_path / "set" / "c" / "images" / "view_006.png").write_bytes(b"no photo")
    data = f"data={{type: qgs/photos, path: {tmp_path / 'set'}, image_size: [32, 32], holdout: 4}}"
    recipe = tiny("tokengs", data, "evaluation.scenes=9")
    summary = (evaluation := evaluate(recipe.build_model(), recipe)).summary()
    assert [score.scene for score in evaluation.scores] == ["a"]
    assert list(summary["missing"]) == ["b", "c"]
    assert summary["held_out_frames"] == (3, 3)
    assert str(tmp_path) not in json.dumps(summary)
    assert all(summary["missing"].values())


def test_failed_samples_fail_their_scene(tiny: Tiny, monkeypatch: pytest.MonkeyPatch) -> None:
    recipe = tiny("tokengs", "evaluation.samples=3")
    score, factors = Psnr.forward, chain([1] * (2 * len(METHODS) - 1), [math.inf], repeat(1))
    monkeypatch.setattr(Psnr, "forward", lambda self, given: score(self, given) * next(factors))
    evaluation = evaluate(recipe.build_model(), recipe)
    assert [failure.scene for failure in evaluation.missing] == ["test/000000"]
    assert [len(score.views) for score in evaluation.scores] == [3]


def test_tuned_evaluations_say_so_and_score_the_tuned_tokens(tiny: Tiny) -> None:
    plain, tuned = tiny("locus"), tiny("locus", "evaluation.tuning_steps=2")
    model = plain.build_model()
    before = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    first, second = evaluate(model, plain), evaluate(model, tuned, batch=2)
    assert same(model.state_dict(), before)
    assert first.protocol.sha256 != second.protocol.sha256
    assert first.summary()["tuning"] is None
    told = second.summary()["tuning"]
    assert (told["steps"], told["rate"], told["optimizer"]) == (2, 1e-4, "Adam")
    assert told["loss_after"] < told["loss_before"]
    assert first.scores[0].values["model_psnr"] != second.scores[0].values["model_psnr"]
    assert "queries tuned on the input views: 2 steps of Adam at 0.0001" in shown(second)
