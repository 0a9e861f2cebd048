"""`qgs scene` on a tiny folder: its files, what it chooses, and the command that it prints."""

import io
import json
import shlex
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock as Mock

import pytest
import torch
from commands import MODEL, run_qgs
from PIL import Image
from plyfile import PlyData
from qgs_refine import scene as making
from qgs_refine.planning import (
    LEAST_STEPS,
    NONE,
    Plan,
    Scenes,
    affordable,
    judged_frames,
    sized,
)
from qgs_refine.refining import Extras
from qgs_refine.scene import photos_start, photos_world
from rich.console import Console
from test_refining import RENDERER, cloud, ring

import qgs
from qgs.analysis.scale import further_photos
from qgs.data.samples import views_in
from qgs.drawing.images import rgb_picture
from qgs.geometry.transforms import matrix_to_quat, moved

FEW = ("--size", "32x48", "--gaussians", "300")


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Nine photos, 48 wide and 32 high, of a cloud of 60 Gaussians, in a cameras.json."""
    folder, cameras = tmp_path_factory.mktemp("photos"), ring(9, 48)
    entries = []
    for number, image in enumerate(RENDERER(cloud(60), cameras).rgb[0].detach()):
        Image.fromarray(rgb_picture(image)[8:40]).save(folder / f"{number}.png")
        fx, fy, cx, cy = cameras.intrinsics[0, number].tolist()
        lens = [[fx, 0, cx], [0, fy, cy - 8], [0, 0, 1]]
        c2w = cameras.c2w[0, number].tolist()
        entries.append({"c2w": c2w, "K": lens, "image": f"{number}.png"})
    (folder / "cameras.json").write_text(json.dumps(entries))
    return folder


def record_of(out: Path) -> dict[str, Any]:
    return json.loads((out / "metrics.json").read_text())


def test_a_scene_is_made_in_seconds_and_can_be_made_again(photos: Path, tmp_path: Path) -> None:
    out = tmp_path / "scene"
    made = run_qgs("scene", photos, "--out", out, "--minutes", 5 / 60, *FEW)
    assert made.exception is None, made.output
    names = {"scene.ply", "scene.splat", "index.html", "metrics.json", "held_out.png"}
    assert {path.name for path in out.iterdir()} == names
    record = record_of(out)
    assert [row["photo"] for row in record["held_out"]] == ["4.png"]
    assert "4.png" not in record["refined_on"]
    assert len(record["refined_on"]) == 8
    assert record["gaussians"] == len(PlyData.read(out / "scene.ply")["vertex"]) == 300
    command = record["command"]
    assert command in made.output
    words = shlex.split(command)[1:]
    assert words[words.index("--model") + 1] == NONE
    words[words.index("--out") + 1] = str(tmp_path / "again")
    words[words.index("--seconds") + 1] = "1"
    again = run_qgs(*words)
    assert again.exception is None, again.output
    assert shlex.split(record_of(tmp_path / "again")["command"])[1:] == words


def test_the_scene_is_in_the_world_of_the_photos(photos: Path, tmp_path: Path) -> None:
    made = run_qgs("scene", photos, "--out", tmp_path / "out", "--seconds", 2, *FEW)
    assert made.exception is None, made.output
    views = qgs.read_photos(photos)
    gaussians = qgs.load_ply(tmp_path / "out" / "scene.ply")
    record = record_of(tmp_path / "out")
    background = torch.tensor(record["background"])
    rgb = RENDERER(gaussians, views.cameras, background).rgb
    error = (rgb - views.images).square().mean((0, 2, 3, 4))
    assert float(-10 * error[4].log10()) == pytest.approx(record["mean"]["psnr"], abs=0.3)


def test_a_model_makes_the_start(photos: Path, tmp_path: Path) -> None:
    file = tmp_path / "model.safetensors"
    data = {"type": "qgs/photos", "path": "elsewhere", "image_size": [16, 16]}
    views = {"inputs": 2, "targets": 2, "gap": [2, 4]}
    qgs.save(qgs.compose({"recipe": 1, "model": MODEL, "data": data, "views": views}), file)
    model = ("--model", file, "--frames", "0,2", "--scale", "0.5")
    options = (*model, "--holdout", NONE, "--seconds", "0.5", *FEW)
    made = run_qgs("scene", photos, "--out", tmp_path / "out", *options)
    assert made.exception is None, made.output
    record = record_of(tmp_path / "out")
    assert record["held_out"] == []
    assert len(record["refined_on"]) == 9
    assert "--frames 0.png,2.png --scale 0.5 " in record["command"]


def test_without_the_viewer_there_is_no_page(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("qgs.extensions.installed", lambda group: ())
    console = Console(file=io.StringIO(), width=200)
    assert making._page_writer(console) is None
    assert "pip install query-gaussians-viewer" in console.file.getvalue()  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--model", NONE, "--scale", "0.4"), "--scale are of a model"),
        (("--minutes", "0"), "--minutes"),
        (("--seconds", "inf"), "--seconds"),
        (("--holdout", "1"), "--holdout"),
        (("--size", "big"), "HxW"),
    ],
)
def test_options_that_cannot_be_used_are_refused(
    photos: Path, tmp_path: Path, options: tuple[str, ...], message: str
) -> None:
    made = run_qgs("scene", photos, "--out", tmp_path / "out", *options)
    assert isinstance(made.exception, ValueError)
    assert message in str(made.exception)
    assert not (tmp_path / "out").exists()


def test_a_folder_with_something_in_it_is_refused(photos: Path) -> None:
    made = run_qgs("scene", photos, "--out", photos)
    assert isinstance(made.exception, FileExistsError)


@pytest.mark.parametrize(
    ("count", "holdout", "held"),
    [(20, "8", (4, 12)), (7, "8", (3,)), (3, "8", (1,)), (2, "8", ()), (7, "3", (1, 4))],
)
def test_judged_frames(count: int, holdout: str, held: tuple[int, ...]) -> None:
    scene = Mock(held_out=(), __len__=lambda self: count)
    assert judged_frames(scene, holdout) == held
    assert judged_frames(scene, NONE) == ()


def test_a_split_of_the_photos_goes_first() -> None:
    scene = Mock(held_out=(0, 5), __len__=lambda self: 20)
    assert judged_frames(scene, "8") == (0, 5)
    assert judged_frames(scene, NONE) == ()


def test_more_time_buys_larger_photos_and_more_gaussians(photos: Path) -> None:
    scenes = Scenes(str(photos), None, "8", None, None)
    scenes.probe.stored_size = lambda frame: (720, 1280)  # type: ignore[method-assign]
    step, free = 0.01, (None, None)
    sizes = [affordable(step, (128, 128), 2048, scenes, t, free) for t in (1, 120, 1200, 1e9)]
    assert sizes == sorted(sizes)
    assert [size for size, _ in sizes][::3] == [(96, 171), (720, 1280)]
    assert len({size for size, _ in sizes}) == 4
    assert affordable(step, (128, 128), 2048, scenes, 1, ((90, 160), 77)) == ((90, 160), 77)
    assert step * LEAST_STEPS < 120


def test_photos_are_never_enlarged(photos: Path) -> None:
    assert sized(Scenes(str(photos), None, "8", None, None).probe, 128) == (32, 48)


def test_a_plan_is_a_command_line() -> None:
    plan = Plan("rooms/locus-64", ("a b.jpg", "c.jpg"), 0.381966, (64, 112), 900, 30.4, "8")
    words = shlex.split(plan.command("my photos", "out", "walk"))
    assert words[:5] == ["qgs", "scene", "my photos", "--out", "out"]
    assert words[5:] == [
        *("--scene", "walk", "--model", "rooms/locus-64", "--frames", "a b.jpg,c.jpg"),
        *("--scale", "0.38197", "--size", "64x112", "--gaussians", "900", "--seconds", "30"),
        *("--holdout", "8", "--degree", "0"),
    ]
    extras = Extras(degree=2, exposure=True, poses=True)
    words = shlex.split(replace(plan, extras=extras, masks=True).command("photos", "out"))
    assert words[-5:] == ["--degree", "2", "--exposure", "--refine-poses", "--masks"]


def test_points_of_colmap_are_part_of_the_start(photos: Path, tmp_path: Path) -> None:
    """Of a folder of scenes, the cameras as a COLMAP model whose one point is far to the side."""
    shutil.copytree(photos, tmp_path / "other")
    tmp_path /= "mine"
    place = tmp_path / "sparse/0"
    place.mkdir(parents=True)
    (tmp_path / "images").mkdir()
    lines = list[str]()
    for number, camera in enumerate(json.loads((photos / "cameras.json").read_text())):
        w2c = torch.tensor(camera["c2w"]).inverse()
        values = [*matrix_to_quat(w2c[:3, :3]).tolist(), *w2c[:3, 3].tolist()]
        lines.append(f"{number + 1} {' '.join(map(str, values))} 1 {number}.png\n\n")
        shutil.copy(photos / f"{number}.png", tmp_path / "images")
    (place / "images.txt").write_text("".join(lines))
    (place / "cameras.txt").write_text("1 PINHOLE 48 32 48 48 24 16\n")
    (place / "points3D.txt").write_text("1 5 6 7 255 0 0 0.5 1 1\n")
    scenes = Scenes(str(tmp_path.parent), tmp_path.name, "8", None, None)
    world = photos_world(scenes)
    views = views_in(world, scenes.probe, scenes.frames)
    found = photos_start(scenes.probe, world, views, 100, 40)
    assert found.count == 41
    point = moved(found, world[0], 1 / float(world[1])).means[0, 0]
    torch.testing.assert_close(point, torch.tensor([5.0, 6, 7]), atol=1e-4, rtol=0)
    other = Scenes(str(photos), None, "8", None, None)
    found = photos_start(other.probe, photos_world(other), views, 100, 40)
    assert found.count == making.TIMED


def test_a_start_is_judged_on_photos_taken_nearby_whatever_their_order() -> None:
    c2w = torch.eye(4).repeat(6, 1, 1)
    c2w[:, 0, 3] = torch.tensor([0.0, 5.0, 1.0, 0.4, 3.0, 0.6])
    scene = Mock(held_out=(), times=None, cameras=Mock(c2w=c2w))
    scene.__len__.return_value = 6
    assert further_photos(scene, (0, 2), (), 2) == (3, 5)
    assert further_photos(scene, (0, 2), (), 3) == (3, 4, 5)
    assert further_photos(scene, (4,), (), 2) == (1, 2)
