"""The scale of photos in another unit is found, and is the same in all commands."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from commands import run_qgs
from photo_formats import real_folder
from PIL import Image
from qgs_viewer.contest import checkpoints, judge
from qgs_viewer.scales import summary
from qgs_viewer.sources import ModelSource, Wanted, open_source
from small import Walk, model_of

import qgs
from qgs.analysis.scale import (
    FoundScale,
    ScaleSearch,
    find_scale,
    further_photos,
    photo_settings,
    search_range,
)
from qgs.composer import resolve
from qgs.contracts import ViewsConfig
from qgs.data.domain import Domain

MODEL, UNIT = "rooms/tokengs-64", 7.0


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Photos of a room of the training's kind, UNIT times as large."""
    folder = tmp_path_factory.mktemp("room")
    recipe = resolve(qgs.load(MODEL).recipe or {}, ["data.views_per_scene=12"])
    scene = recipe.build_data().scenes("test")[0]
    frames = []
    cameras = scene.cameras
    fx, fy, cx, cy = cameras.intrinsics[0].tolist()
    for number, image in enumerate(scene.images(range(12))):
        pixels = (image.permute(1, 2, 0) * 255).round().byte().numpy()
        Image.fromarray(pixels).save(folder / f"{number:02d}.png")
        pose = cameras.c2w[number].double().clone()
        pose[:3, 3] *= UNIT
        pose[:, 1:3] *= -1
        frames.append({"file_path": f"{number:02d}.png", "transform_matrix": pose.tolist()})
    lens = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": 64, "h": 64}
    (folder / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    return folder


def test_a_room_in_another_unit_has_its_own_scale(room: Path) -> None:
    found = qgs.load(MODEL).reconstruct(room, frames=[3, 6], compare=[4]).scale
    trained = resolve(qgs.load(MODEL).recipe or {}).views.scale_factor
    assert found.factor == pytest.approx(trained / UNIT, rel=0.15)
    assert 5 in found.further
    assert not {3, 4, 6} & {*found.further}
    assert found.psnr == max(psnr for _, psnr in found.tried)
    assert not found.poor


@pytest.mark.parametrize("place", ["room", pytest.param("office_walk", marks=pytest.mark.slow)])
def test_all_commands_find_the_same_scale(
    place: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    photos = request.getfixturevalue("room") if place == "room" else real_folder(place)
    entry = judge(checkpoints([MODEL]), str(photos), "cpu")[0]
    (_, inputs, compared), found = next(iter(entry.search.found.items()))
    run_qgs("reconstruct", MODEL, photos, "--out", tmp_path / "out")
    record = json.loads((tmp_path / "out/cameras.json").read_text())
    assert record["to_photos"]["scale"] == pytest.approx(found.factor, rel=1e-6)
    assert record["to_photos"]["search"] == found.record
    again = qgs.load(MODEL).reconstruct(photos, frames=inputs, compare=compared)
    assert again.scale == found
    opened = open_source(MODEL, Wanted(photos=str(photos)))
    assert isinstance(opened, ModelSource)
    assert tuple(opened.frames) == inputs
    assert opened.views.scale_factor == pytest.approx(found.factor, rel=1e-6)
    quality = [view["psnr"] for view in record["views"] if view["kind"] == "novel"]
    first = entry.evaluation.scores[0]
    if len(first.views) == 1:
        assert sum(quality) / len(quality) == pytest.approx(first.values["model_psnr"], abs=0.01)


def test_all_commands_choose_the_same_inputs_of_photos_that_the_model_knows(
    room: Path, tmp_path: Path
) -> None:
    data = {"type": "qgs/photos", "path": str(room), "holdout": 4}
    recipe = resolve({**(qgs.load(MODEL).recipe or {}), "data": data})
    qgs.save(recipe.build_model(), tmp_path / "own.safetensors")
    name = str(tmp_path / "own.safetensors")
    result = qgs.load(name).reconstruct(room)
    opened = open_source(name, Wanted(photos=str(room)))
    judged = judge(checkpoints([name]), str(room), "cpu")[0].evaluation.scores[0].views[0]
    assert tuple(opened.frames) == result.sample.input_frames == judged[0]
    assert result.sample.target_frames == judged[1]
    assert {*judged[1]} <= {2, 6, 10}


def test_a_scale_can_be_set(room: Path, tmp_path: Path) -> None:
    out, options = tmp_path / "out", ("--frames", "3,6")
    done = run_qgs("reconstruct", MODEL, room, "--out", out, *options, "--scale", "0.5")
    assert done.exception is None
    record = json.loads((out / "cameras.json").read_text())
    assert record["to_photos"]["scale"] == pytest.approx(0.5)
    assert record["to_photos"]["search"] is None
    source = open_source(MODEL, Wanted(photos=str(room), overrides=["views.scale=auto"]))
    assert isinstance(source, ModelSource)
    assert source.views.scale == "auto"
    done = run_qgs("reconstruct", MODEL, room, "--out", tmp_path / "b", "--scale", "0")
    assert "--scale" in str(done.exception)


def test_settings_search_where_nothing_is_known() -> None:
    views = ViewsConfig(scale="constant")
    assert photo_settings(views, own=False).scale == "search"
    assert photo_settings(views, own=True).scale == "constant"
    assert photo_settings(views, False, ["views.scale_factor=2"]).scale == "constant"
    assert photo_settings(ViewsConfig(scale="distance"), own=False).scale == "distance"


def test_further_photos_lie_between_and_are_not_compared_with() -> None:
    assert further_photos(Walk(), (1, 5), (2, 4)) == (0, 3)
    assert 2 in further_photos(Walk(), (0, 4), ())
    assert further_photos(Walk(), (0, 4), (2,)) == (1, 3)
    held_out = type("Held", (Walk,), {"held_out": (1, 2)})()
    assert further_photos(held_out, (0, 4), ()) == (3, 5)
    assert further_photos(held_out, (0, 4), (3, 5)) == ()


def test_without_further_photos_an_input_is_judged_or_inputs_alone() -> None:
    views, model = ViewsConfig(inputs=2, scale="search"), model_of("tokengs")
    three = find_scale(model, Walk(), (0, 2, 4), (1, 3, 5), views)
    assert three.further == (2,)
    two = find_scale(model, Walk(), (1, 4), (0, 2, 3, 5), views)
    assert two.further == ()
    assert two.poor
    search = ScaleSearch(model, views)
    chosen = search(Walk(), (0, 2, 4), (1, 3, 5))
    assert (chosen.scale, chosen.scale_factor) == ("constant", three.factor)
    assert search(Walk(), (0, 2, 4), (1, 3, 5)) == chosen


def test_the_range_follows_the_unit_and_the_training() -> None:
    trained = Domain({"baseline": [0.1, 0.4], "depth": [0.8, 3.0]}, 4)
    low, high, nearest = search_range(trained, Walk(), (1, 4))
    assert low < 0.8 / 3 < high
    assert nearest == pytest.approx(1.0 / 3, rel=1e-3)  # the cameras of Walk look 3 away
    still = type("Still", (Walk,), {"cameras": Walk().cameras[[2, 2]]})()
    assert search_range(Domain(), still, (0, 1)) == (1.0, 1.0, 0.0)


def test_words_of_several_windows() -> None:
    one = FoundScale(0.4, 20.0, (3,), ["3.png"], [(0.4, 20.0)], 0.5)
    bad = replace(one, factor=0.6, psnr=12.3)
    assert "0.4 to 0.6" in summary([one, bad])
    assert "1 window" in summary([one, bad])
    assert "3.png" in summary([one])
    assert "12.3 dB" in bad.poor
    assert "alone" in replace(one, further=()).poor
    assert not one.poor


def test_training_and_evaluation_refuse_a_search(tmp_path: Path) -> None:
    words = ("--set", "views.scale=search", "--set", "training.steps=1")
    done = run_qgs("train", "recipes/tiny/tokengs.yaml", "--out", tmp_path / "run", *words)
    assert "views.scale: search" in f"{done.output}{done.exception}"
