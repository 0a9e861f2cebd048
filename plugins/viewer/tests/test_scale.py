"""The scale of photos in another unit is found, and is the same in all commands."""

import json

import pytest
from commands import done
from photo_formats import PhotoSet, write_nerfstudio
from qgs_viewer.comparison import open_models
from qgs_viewer.opening import open_source

import qgs
from qgs.drawing.images import rgb_picture, write_png
from qgs.recipe import resolve

MODEL = "rooms/tokengs-64"
UNIT = 7.0


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """Photos of a room of the training's kind, UNIT times as large."""
    folder = tmp_path_factory.mktemp("room")
    recipe = resolve(qgs.load(MODEL).recipe, ["data.views_per_scene=12"])
    scene = recipe.build_data().scenes("test")[0]
    files = [folder / f"{number:02d}.png" for number in range(12)]
    for file, image in zip(files, scene.images(range(12)), strict=True):
        write_png(rgb_picture(image), file)
    c2w = scene.cameras.c2w.double().numpy()
    c2w[:, :3, 3] *= UNIT
    photos = PhotoSet(files, c2w, scene.cameras.intrinsics[0].tolist(), scene.cameras.size)
    return write_nerfstudio(folder / "photos", photos)


def test_a_room_in_another_unit_has_its_own_scale_in_all_commands(room, tmp_path):
    """With the same score too, of the one window that is judged."""
    (result,) = open_models([MODEL], str(room), "cpu")
    (score,) = result.evaluation.scores
    (_, inputs, compared), found = next(iter(result.search.found.items()))
    done("reconstruct", MODEL, room, "--out", tmp_path / "out")
    record = json.loads((tmp_path / "out/cameras.json").read_text())
    assert record["to_photos"]["scale"] == pytest.approx(found.factor)
    assert record["to_photos"]["search"] == found.record
    opened = open_source(MODEL, photos=str(room))
    assert tuple(opened.frames) == inputs
    assert opened.views.scale_factor == pytest.approx(found.factor)
    quality = [view["psnr"] for view in record["views"] if view["kind"] == "novel"]
    assert sum(quality) / len(quality) == pytest.approx(score.values["model_psnr"], abs=0.01)
    trained = resolve(qgs.load(MODEL).recipe).views.scale_factor
    assert found.factor == pytest.approx(trained / UNIT, rel=0.15)
    assert found.further
    assert {*inputs, *compared}.isdisjoint(found.further)
    assert found.psnr == max(psnr for _, psnr in found.tried)
    assert not found.poor


def test_a_scale_can_be_set(room, tmp_path):
    source = open_source(MODEL, photos=str(room), overrides=["views.scale=auto"])
    assert source.views.scale == "auto"
    out = ("--out", tmp_path / "out")
    for words in (
        ("reconstruct", MODEL, room, *out),
        ("demo", room, "--model", MODEL, *out),
        ("report", MODEL, "--photos", room, *out),
        ("view", MODEL, room),
    ):
        with pytest.raises(ValueError, match="--scale"):
            done(*words, "--scale", "0")
