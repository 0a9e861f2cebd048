"""`qgs demo` and `qgs report`: who is compared, on which photos, and what the page says."""

import html
import json
import re
import shlex
import shutil
from pathlib import Path
from unittest.mock import Mock

import pytest
import yaml
from commands import done
from photo_formats import noisy_photos
from qgs_viewer.commands import new_folder
from qgs_viewer.compare import ON_PHOTOS, RECIPES, compare_models
from qgs_viewer.comparison import open_models, resolve_fairly
from qgs_viewer.curves import curves_of
from qgs_viewer.scenes import model_scenes
from small import RECIPE, stand_in

import qgs


@pytest.mark.slow
def test_recipes_are_trained_compared_and_reported(tmp_path):
    done("demo", "--train", *RECIPES, "--seconds", 1, "--out", tmp_path)
    for name in ("tokengs", "locus"):
        for file in ("checkpoint.safetensors", "evaluation/summary.json"):
            assert (tmp_path / name / file).is_file()
    assert "type: locus/" in (tmp_path / "report.html").read_text()


def test_recipes_with_other_data_are_not_compared(tmp_path):
    few, more = (tmp_path / f"{name}.yaml" for name in ("few", "more"))
    few.write_text(yaml.safe_dump(RECIPE))
    more.write_text("{recipe: 1, extends: few.yaml, views: {gap: [2, 5]}}")
    assert [*resolve_fairly([few, few], seconds=1, seed=0)] == ["few", "few (2)"]
    with pytest.raises(ValueError, match="more and few differ in views"):
        resolve_fairly([few, more], seconds=1, seed=0)


def test_all_systems_can_be_compared():
    """Though C3G trains on its input views and tuning would tune other things."""
    names = "tokengs locus ellipsoid gslrm c3g globalsplat tokengs_latent"
    files = [Path(f"tiny/{name}.yaml") for name in names.split()]
    assert resolve_fairly(files, seconds=1, seed=0)["c3g"].training.judge_inputs


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")
    return [stand_in(folder / f"{name}.safetensors") for name in ("few", "more")]


def opened(names, photos):
    return open_models(names, str(photos), "cpu")


def test_a_report_on_photos_says_what_was_printed_and_what_to_do_next(
    models, tmp_path, monkeypatch, caplog
):
    monkeypatch.chdir(tmp_path)
    photos = noisy_photos(tmp_path / "my photos", 12)
    shutil.copy(photos / "transforms.json", photos / "transforms_train.json")
    shown = done("report", *models, "--photos", photos, "--scale", "0.5").output
    page = html.unescape(Path("report/report.html").read_text())
    notes = page.partition("<ul>")[2].partition("</ul>")[0]
    for remark in re.findall("<li>(.*)</li>", notes):
        assert remark in shown + caplog.text
    assert "2 formats" in notes
    assert "few, more: the views lie outside" in notes
    assert "my photos" in page.partition("Next:")[2].partition("</p>")[0]

    lines = shown.partition("Next:\n")[2].splitlines()
    # as a shell would
    commands = [shlex.split(line, comments=True) for line in lines]
    assert [command[1] for command in commands] == ["reconstruct", "refine", "view"]
    reconstruct, refine, view = commands
    for _, name, model, place, *options in (reconstruct, view):
        assert model in models
        assert (place, options[:2]) == (str(photos), ["--scale", "0.5"])
        known = done(name, "--help").output
        assert all(word in known for word in options if word.startswith("--"))
    assert refine[2:] == ["report/scene", str(photos)]
    done(*reconstruct[1:])
    record = json.loads(Path("report/scene/cameras.json").read_text())["to_photos"]
    assert (record["scale"], record["search"]) == (0.5, None)


def test_a_checkpoint_has_a_history_of_its_own_or_of_its_run(tmp_path):
    assert not curves_of(tmp_path / "other.safetensors")
    for step, name in enumerate(["own.history.jsonl", "history.jsonl"]):
        record = {"step": step, "seconds": 1.0, "loss": 1.0, "psnr": 9.0}
        (tmp_path / name).write_text(json.dumps(record) + "\n")
    found = [curves_of(tmp_path / f"{name}.safetensors") for name in ("own", "other")]
    assert [[record["step"] for record in records] for records in found] == [[0], [1]]


def test_small_scenes_keep_their_photos_and_others_every_eighth(models, tmp_path):
    for name, count in (("large", 20), ("small", 3), ("tiny", 2)):
        noisy_photos(tmp_path / name, count)
    (result,) = opened(models[:1], tmp_path)
    compared = {
        score.scene: {frame for _, frames in score.views for frame in frames}
        for score in result.evaluation.scores
    }
    assert compared == {"large": {4, 12}, "small": {1}}
    assert [missing.scene for missing in result.evaluation.missing] == ["tiny"]


def test_two_photos_leave_nothing_to_compare_with(models, tmp_path):
    photos = noisy_photos(tmp_path / "two", 2)
    out = tmp_path / "demo"
    with pytest.raises(ValueError, match="none is left to compare with"):
        done("demo", photos, "--model", models[0], "--out", out)
    assert not out.exists()


def test_a_model_tuned_on_the_photos_is_compared_on_those_it_never_saw(models, tmp_path):
    photos = str(noisy_photos(tmp_path / "mine", 20))
    data = f"data={{type: qgs/photos, path: {photos}, image_size: [16, 16], holdout: 5}}"
    tuned = str(tmp_path / "tuned.safetensors")
    qgs.save(qgs.compose(RECIPE, [data, "views.gap=[1, 3]", "views.scale=auto"]), tuned)
    results = opened([models[0], tuned], photos)
    assert [result.recipe.views.scale for result in results] == ["search", "auto"]
    before, after = ([score.views for score in r.evaluation.scores] for r in results)
    assert before == after
    assert {frame for views in before for _, frames in views for frame in frames} <= {2, 7, 12, 17}
    shown = model_scenes(results, 2)
    ends = {float(own.samples[0].inputs.cameras.c2w[0, -1, :3, 3].norm()) for own in shown}
    assert len(ends) == 2


def test_photos_meet_models_of_their_size(tmp_path, monkeypatch):
    refusing = Mock(side_effect=FileNotFoundError)
    monkeypatch.setattr("qgs_viewer.compare.open_models", refusing)
    for size, side in ((None, 128), ("128x192", 128), ("64x64", 64)):
        with pytest.raises(FileNotFoundError):
            compare_models(None, str(tmp_path), tmp_path, "cpu", size)
        assert refusing.call_args.args[0] == ON_PHOTOS[side]


def test_an_earlier_demo_is_never_touched(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert new_folder(None, "demo").name == "demo"
    (tmp_path / "demo").mkdir()
    assert new_folder(None, "demo").name == "demo-2"
    (tmp_path / "demo/report.html").touch()
    with pytest.raises(FileExistsError, match="not empty"):
        new_folder(tmp_path / "demo", "demo")
