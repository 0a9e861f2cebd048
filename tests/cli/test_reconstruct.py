import json
import shutil
from functools import partial

import numpy as np
import pytest
from commands import MODEL, run_qgs
from photo_formats import noisy_photos, opened, row_of_frames
from PIL import Image
from plyfile import PlyData

import qgs
from qgs.analysis.scenes import frame_list

RECIPE = {
    "recipe": 1,
    "model": MODEL,
    "plugins": ["rooms"],
    "data": {"type": "rooms/procedural", "image_size": [16, 16]},
    "views": {"inputs": 2, "targets": 2, "gap": [2, 4], "scale": "constant"},
}


run = partial(run_qgs, "reconstruct")


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    path = tmp_path_factory.mktemp("run") / "checkpoint.safetensors"
    qgs.save(qgs.compose(RECIPE), path)
    return path


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    return noisy_photos(tmp_path_factory.mktemp("photos") / "row")


def test_everything_is_written(checkpoint, photos, tmp_path):
    result = run(checkpoint, photos, "--out", tmp_path / "scene")
    assert result.exception is None
    out = tmp_path / "scene"
    assert PlyData.read(out / "gaussians.ply")["vertex"].count == 32
    cameras = json.loads((out / "cameras.json").read_text())
    assert [view["frame"] for view in cameras["views"]] == [2, 4, 3]
    assert [view["kind"] for view in cameras["views"]] == ["input", "input", "novel"]
    back = cameras["to_photos"]
    for view in cameras["views"]:
        centre = np.array([*(np.array(view["c2w"])[:3, 3] / back["scale"]), 1])
        world = np.array(back["reference_c2w"]) @ centre
        np.testing.assert_allclose(world, [0.1 * view["frame"], 0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(cameras["views"][0]["c2w"], np.eye(4), atol=1e-6)
    assert Image.open(out / "views" / "00003_novel.png").size == (36, 16)
    assert Image.open(out / "depth" / "00004_input.png").size == (16, 16)
    assert Image.open(out / "overview.png").size[0] > 500
    assert Image.open(out / "orbit.gif").n_frames == len(cameras["orbit"])


def test_what_a_user_made_is_kept(checkpoint, photos, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "views").mkdir()
    (tmp_path / "views" / "00099_novel.png").touch()
    refused = run(checkpoint, photos, "--out", tmp_path)
    assert isinstance(refused.exception, FileExistsError)
    assert "--overwrite" in str(refused.exception)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["notes.txt", "views"]
    foreign = run(checkpoint, photos, "--out", tmp_path, "--overwrite")
    assert isinstance(foreign.exception, FileExistsError)
    assert (tmp_path / "views" / "00099_novel.png").is_file()
    (tmp_path / "gaussians.ply").touch()  # as an earlier result has it
    allowed = run(checkpoint, photos, "--out", tmp_path, "--overwrite")
    assert allowed.exception is None
    assert (tmp_path / "notes.txt").read_text() == "mine"
    assert (tmp_path / "gaussians.ply").stat().st_size
    assert not (tmp_path / "views" / "00099_novel.png").exists()
    assert (tmp_path / "views" / "00003_novel.png").is_file()


def test_photos_seen_in_training_are_not_called_novel(photos, tmp_path):
    data = {"type": "qgs/photos", "path": str(photos), "image_size": [16, 16], "holdout": 3}
    file = tmp_path / "checkpoint.safetensors"
    qgs.save(qgs.compose({**RECIPE, "data": data}), file)
    result = run(file, photos, "--out", tmp_path / "a")
    assert result.exception is None
    views = json.loads((tmp_path / "a" / "cameras.json").read_text())["views"]
    assert [view["frame"] for view in views] == [0, 2, 1]
    assert [view["kind"] for view in views] == ["input", "input", "novel"]
    result = run(file, photos, "--out", tmp_path / "b", "--frames", "0,6", "--holdout", "1,3")
    views = json.loads((tmp_path / "b" / "cameras.json").read_text())["views"]
    assert [view["kind"] for view in views] == ["input", "input", "novel", "seen in training"]


def test_photos_are_named_by_number_or_file(checkpoint, photos, tmp_path):
    named = ("--frames", "0.png,images/3.png", "--holdout", "1, 2.png")
    result = run(checkpoint, photos, "--out", tmp_path, *named)
    assert result.exception is None, result.exception
    views = json.loads((tmp_path / "cameras.json").read_text())["views"]
    assert [view["frame"] for view in views] == [0, 3, 1, 2]
    assert [view["photo"] for view in views] == [f"images/{i}.png" for i in (0, 3, 1, 2)]


def test_photos_that_are_not_there_are_refused(photos, tmp_path):
    scene = opened(photos).scenes("train")[0]
    assert frame_list("0,8", "--frames", scene) == [0, 8]
    with pytest.raises(ValueError, match=r"--frames: '0-8' is no photo"):
        frame_list("0-8", "--frames", scene)
    for folder in "ab":
        shutil.copytree(photos / "images", tmp_path / folder)
    frames = row_of_frames(2, fl_x=20, fl_y=20, cx=12, cy=10, w=24, h=20)
    for folder, frame in zip("ab", frames["frames"], strict=True):
        frame["file_path"] = f"{folder}/1.png"
    (tmp_path / "transforms.json").write_text(json.dumps(frames))
    twins = opened(tmp_path).scenes("train")[0]
    assert frame_list("b/1.png", "--frames", twins) == [1]
    with pytest.raises(ValueError, match=r"'1\.png' fits 0 \(a/1\.png\), 1 \(b/1\.png\)"):
        frame_list("1.png", "--frames", twins)


def test_tuned_tokens_meet_the_inputs_better_and_are_told(checkpoint, photos, tmp_path):
    weights = checkpoint.read_bytes()
    trained = ("--scale", 0.15)  # noise has no scale, and at some nothing is seen
    assert run(checkpoint, photos, "--out", tmp_path / "plain", *trained).exception is None
    result = run(checkpoint, photos, "--out", tmp_path / "tuned", "--tune", 3, *trained)
    assert result.exception is None
    plain, tuned = (
        json.loads((tmp_path / name / "cameras.json").read_text()) for name in ("plain", "tuned")
    )
    assert plain["tuning"] is None
    assert tuned["tuning"]["steps"] == 3
    assert tuned["tuning"]["loss_after"] < tuned["tuning"]["loss_before"]
    files = [(tmp_path / name / "gaussians.ply").read_bytes() for name in ("plain", "tuned")]
    assert files[0] != files[1]
    assert checkpoint.read_bytes() == weights


def test_inputs_alone_are_refined_on_and_photos_held_out_of_training_never(photos, tmp_path):
    data = {"type": "qgs/photos", "path": str(photos), "image_size": [16, 16], "holdout": 3}
    file = tmp_path / "checkpoint.safetensors"
    qgs.save(qgs.compose({**RECIPE, "data": data}), file)
    larger = ("--gaussians", 50, "--refine-size", "20x24")
    cases = {"all": (larger, [0, 2, 5, 6]), "inputs": (("--refine-inputs",), [0, 6])}
    for name, (more, frames) in cases.items():
        chosen = ("--frames", "0,6", "--holdout", "1,3", "--refine", 0.05)
        assert run(file, photos, "--out", tmp_path / name, *chosen, *more).exception is None
        record = json.loads((tmp_path / name / "refined" / "cameras.json").read_text())
        assert record["refinement"]["frames"] == frames  # 4 was held out of training
    refined = json.loads((tmp_path / "all" / "refined" / "cameras.json").read_text())
    assert refined["views"][0]["size"] == [20, 24]
    for folder, count in (("all", 32), ("all/refined", 50)):
        assert PlyData.read(tmp_path / folder / "gaussians.ply")["vertex"].count == count


@pytest.mark.parametrize(
    ("options", "frames", "compared"),
    [
        pytest.param((), [0, 1, 2, 4, 5, 6], [3], marks=pytest.mark.slow),
        pytest.param(("--holdout", "none"), [*range(7)], [], marks=pytest.mark.slow),
        (("--holdout", "1.png,3"), [0, 2, 4, 5, 6], [1, 3]),
        (("--frames", "2,3"), [*range(7)], []),  # 3 is the held-out one
    ],
)
def test_photos_held_out_are_compared_with_and_not_refined_on(
    checkpoint, photos, tmp_path, options, frames, compared
):
    assert run(checkpoint, photos, "--out", tmp_path, *options, "--refine", 0.02).exception is None
    record = json.loads((tmp_path / "refined" / "cameras.json").read_text())
    assert record["refinement"]["frames"] == frames
    assert [view["frame"] for view in record["views"] if view["kind"] == "novel"] == compared


@pytest.mark.parametrize(
    "options",
    [
        ("--gaussians", 50),
        ("--refine-inputs",),
        ("--refine", 0),
        ("--refine", 1, "--refine-size", "64"),
        ("--set", "views.scale=big"),
        ("--set", "data.path=x"),
    ],
)
def test_options_that_make_no_sense_are_refused(checkpoint, photos, tmp_path, options):
    result = run(checkpoint, photos, "--out", tmp_path / "out", *options)
    assert isinstance(result.exception, ValueError)
    assert options[0] in str(result.exception) or "views" in str(result.exception)
    assert not (tmp_path / "out").exists()


def test_the_world_is_scaled_as_asked_for(checkpoint, photos, tmp_path, caplog):
    cases = {"scale_factor=0.5": 0.5, "scale=auto": 1 / 0.6}  # a row of 7, 0.1 apart, looks ahead
    for setting, factor in cases.items():
        out = tmp_path / setting
        options = ("--out", out, "--set", f"views.{setting}")
        assert run(checkpoint, photos, *options).exception is None
        record = json.loads((out / "cameras.json").read_text())
        assert record["to_photos"]["scale"] == pytest.approx(factor)
