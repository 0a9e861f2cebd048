"""`qgs scene` on a tiny folder: its files, what it chooses, and the points that it starts from."""

import re
import shutil
import struct
import sys
from dataclasses import replace
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch
from commands import done, run_qgs
from photo_formats import photo_set, synthetic, write_colmap, write_nerfstudio
from PIL import Image
from qgs_photos.poses.filming import open_film_scene
from qgs_photos.refine import scene
from qgs_photos.refine.budget import TIMED, Budget
from qgs_photos.refine.earlier import chosen_start
from qgs_photos.refine.initial import from_points, photos_start, photos_world, sparse_points
from qgs_photos.refine.options import NONE, Options
from qgs_photos.refine.result import has_viewer
from qgs_photos.refine.scene import faults_of_given_poses
from qgs_photos.refine.scene_photos import ScenePhotos, judged_frames, sized
from tables import must_not_find, must_refuse, names_in, read_json, rows, text_console
from test_gltf import opened
from test_refining import mean_psnr
from textured_room import INTRINSICS, walk
from torch.testing import assert_close
from training_runs import tiny
from upath import UPath

import qgs
from qgs.containers import concatenated
from qgs.data.samples import views_in
from qgs.geometry.transforms import moved


@pytest.fixture(scope="module")
def taken(tmp_path_factory):
    """Nine photos of a textured box, 48 wide and 32 high."""
    shots = walk(9)
    images = [np.array(Image.fromarray(shot.image).resize((48, 32))) for shot in shots]
    lens = [number / 3.75 for number in INTRINSICS]
    c2w = np.stack([shot.c2w for shot in shots])
    return photo_set(tmp_path_factory.mktemp("files"), images, c2w, lens)


@pytest.fixture(scope="module")
def photos(taken, tmp_path_factory):
    return write_nerfstudio(tmp_path_factory.mktemp("photos"), taken)


@pytest.fixture
def photos_of_scene(photos):
    return ScenePhotos(str(photos), Options())


def made(command, out):
    """The output and metrics.json of a `qgs scene` that writes into `out`."""
    result = done(*f"{command} --out {out}".split())
    return result.output, read_json(out / "metrics.json")


def test_a_scene_is_made_in_seconds_and_can_be_made_again_in_the_photos_world(photos, tmp_path):
    out = tmp_path / "scene"
    again = tmp_path / "again"
    few = "--minutes 0.003 --size 32x48 --gaussians 300"
    output, record = made(f"scene {photos} {few}", out)
    files = "scene.ply scene.splat index.html metrics.json held_out.png"
    assert names_in(out) == {*files.split()}
    assert [row["photo"] for row in record["held_out"]] == ["images/4.png"]
    assert record["refined_on"] == [f"images/{number}.png" for number in range(9) if number != 4]
    assert record["gaussians"] == qgs.load_ply(out / "scene.ply").count > 300
    expected, errors = np.transpose(record["expected_and_error"])
    assert (np.diff(expected) > 0).all()
    off = abs(expected / record["error_scale"] - errors).sum() / errors.sum()
    assert record["calibration_error"] == pytest.approx(off)
    mean = record["mean"]
    assert mean["alpha"] > 0.99
    assert errors.mean() == pytest.approx(mean["error"], rel=0.01)
    assert expected.mean() == pytest.approx(mean["expected_error"], rel=0.01)
    foreseen = mean["expected_error"] / record["error_scale"]
    line = f"{mean['error']:.3f}, expected from the other photos {foreseen:.3f}"
    assert line in " ".join(output.split())
    is_worse = mean["psnr"] < mean["nearest_input"]
    assert is_worse == ("worse than the nearest photo" in output)
    assert record["command"] in output
    assert f" --model {NONE} " in record["command"]
    command = re.sub("--seconds [^ ]+", "--seconds 0.2", record["command"])
    command = command.removeprefix("qgs ").replace(f" --out {out}", "")
    _, record = made(command, again)
    assert record["command"].replace(f" --out {again}", "") == f"qgs {command}"

    views = qgs.read_photos(photos).select([4])
    psnr = mean_psnr(qgs.load_ply(again / "scene.ply"), views)
    assert psnr == pytest.approx(record["mean"]["psnr"], abs=0.01)


def test_an_earlier_scene_is_optimised_further(photos, tmp_path, monkeypatch):
    few = "--holdout 4 --seconds 0.3 --degree 0"
    earlier = tmp_path / "a"
    size = "--size 32x48 --gaussians 300 --scale-by 0.png 8.png 2.5"
    output, first = made(f"scene {photos} {few} {size}", earlier)
    assert f"in metres: {first['factor']:.4g} times" in output
    options = Options(earlier=earlier, holdout="4")
    world, given, _ = chosen_start(ScenePhotos(str(photos), options), options)
    ours = moved(given, world[0], 1 / world[1])
    assert first["optimised"] == given.count
    stored = qgs.load_ply(earlier / "scene.ply").means[:, -first["optimised"] :]
    assert_close(first["factor"] * ours.means, stored)
    film = open_film_scene(earlier, str(photos), None)
    start, *_, end = film.cameras.c2w[0, :, :3, 3]
    assert (end - start).norm() == pytest.approx(2.5 * float(film.world[1]))
    going_on = f"scene {photos} --from {earlier}"
    monkeypatch.setattr(scene, "photos_start", None)
    _, record = made(f"{going_on} {few}", tmp_path / "b")
    assert f" --from {earlier} --size 32x48 --gaussians {first['optimised']} " in record["command"]
    assert record["command"].endswith(" --scale-by 0.png 8.png 2.5")
    assert record["factor"] == pytest.approx(first["factor"])
    words = f"{going_on} --holdout 3 --out {tmp_path}/c".split()
    must_refuse("other photos", done, *words)
    must_not_find("scene.ply", done, "scene", photos, "--from", photos, "--out", tmp_path / "c")
    (earlier / "metrics.json").write_text("[]")
    must_refuse("make the scene again", done, *words)


def test_poses_that_came_with_the_photos_are_looked_at(taken, photos_of_scene, tmp_path):
    assert faults_of_given_poses(photos_of_scene) == []
    c2w = taken.c2w.copy()
    c2w[2, 0, 3] += 1e4
    stray = write_nerfstudio(tmp_path / "stray", replace(taken, c2w=c2w))
    photos = ScenePhotos(str(stray), Options())
    assert len(photos.small) == 8
    (fault,) = faults_of_given_poses(photos)
    assert [name for _, name, _ in fault.photos] == ["images/2.png"]
    # COLMAP makes the poses of a video in a folder beside it
    photos.path = str(tmp_path / "walk.mp4")
    (tmp_path / "walk.mp4").touch()
    assert faults_of_given_poses(photos) == []


FEW = "--holdout none --seconds 0.1 --size 32x48 --gaussians 300"


def test_a_model_makes_the_start(photos, tmp_path):
    file = tmp_path / "model.safetensors"
    qgs.save(tiny("photos").build_model(), file)
    model = f"--model {file} --frames 0,2 --scale 0.5"
    _, record = made(f"scene {photos} {model} {FEW}", tmp_path / "out")
    assert record["held_out"] == []
    assert len(record["refined_on"]) == 9
    assert "--frames images/0.png,images/2.png --scale 0.5 " in record["command"]


def ratio_of_cameras(file, photos):
    """Distances between the cameras in a .glb file over those between the photos."""
    content, _ = opened(file)
    _, *nodes, flight = content["nodes"]
    assert [node["name"] for node in nodes] == [f"images/{number}.png" for number in range(9)]
    assert flight["name"] == "flight"
    places = torch.tensor([node["translation"] for node in nodes])
    ratios = torch.pdist(places) / torch.pdist(qgs.read_photos(photos).cameras.c2w[0, :, :3, 3])
    assert_close(ratios, ratios.mean().expand_as(ratios))
    return ratios.mean().item()


def test_a_file_has_the_cameras_too(photos, tmp_path):
    """In the world of the photos, turned upright, in metres; Gaussians have errors to expect."""
    file = tmp_path / "scene.glb"
    output = done(*f"scene {photos} {FEW} --scale-by 0.png 8.png 2.5 --out {file}".split()).output
    assert names_in(tmp_path) == {"scene.glb"}
    assert f"wrote {file}" in output
    assert qgs.load_ply(file).features.shape[1:] == (qgs.load_ply(file).count, 1)
    assert f"in metres: {ratio_of_cameras(file, photos):.4g} times" in output


def test_floaters_are_left_out_of_a_file(photos, photos_of_scene, tmp_path):
    world = photos_world(photos_of_scene)
    views = views_in(world, photos_of_scene.small, photos_of_scene.frames)
    walls = photos_start(photos_of_scene.small, world, views, 400, 40)
    ahead, eye = views.cameras.c2w[0, 0, :3, 2:].T
    scales = torch.full((1, 1, 3), 0.002)
    near = walls[:, :1].replace(means=(eye + 0.05 * ahead)[None, None], scales=scales)
    both = moved(concatenated([near, walls], 1), world[0], 1 / world[1])
    qgs.save_ply(both, tmp_path / "a.ply")
    file = tmp_path / "b.glb"
    output = done(f"clean {tmp_path}/a.ply {photos} {file}").output
    assert f"{walls.count:,} of {both.count:,} Gaussians" in output
    assert_close(qgs.load_ply(file).means, both.means[:, 1:])
    assert ratio_of_cameras(file, photos) == pytest.approx(1)


def test_an_interrupt_before_the_optimisation_says_what_is_kept(photos, tmp_path, monkeypatch):
    monkeypatch.setattr(scene, "chosen_start", MagicMock(side_effect=KeyboardInterrupt))
    result = run_qgs("scene", photos, "--out", tmp_path / "out")
    assert "out is not written" in result.output
    assert result.exit_code == 130


def test_without_the_viewer_there_is_no_page(monkeypatch):
    monkeypatch.setitem(sys.modules, "qgs_viewer.page", None)
    console = text_console()
    assert not has_viewer(console)
    assert "pip install" in console.file.getvalue()


SENSELESS = """
--model none --scale 0.4 | --scale need a model
--model none --from scene | replaces a model
--minutes 0 | --minutes
--seconds inf | --seconds
--holdout 1 | --holdout
--size big | HxW
--scale-by 0.png 9.png 1 | 0 photos are named 9.png
--scale-by 0.png 0.png 1 | needs two points
--scale-by 0.png 8.png 0 | needs two points
--scale-by 0.png 8.png:48,3 1 | x from 0 to 48
--scale-by 0.png 8.png:7,3 1 --size 32x32 | x from 8 to 40
--scale-by 0.png:a 8.png 1 | 0 photos are named 0.png:a
"""


def test_options_that_cannot_be_used_are_refused(photos, tmp_path):
    out = tmp_path / "out"
    for options, message in rows(SENSELESS):
        must_refuse(message, done, *f"scene {photos} --out {out} {options}".split())
    assert not out.exists()
    # nor is a folder with something in it written into
    assert isinstance(run_qgs("scene", photos, "--out", photos).exception, FileExistsError)


def test_a_split_of_the_photos_own_is_judged_first():
    scene = MagicMock(held_out=(), __len__=lambda self: 20)
    assert judged_frames(scene, "8") == (4, 12)
    assert judged_frames(scene, "3") == (1, 4, 7, 10, 13, 16, 19)
    assert judged_frames(scene, NONE) == ()
    scene.held_out = (0, 5)
    assert judged_frames(scene, "8") == (0, 5)
    assert judged_frames(scene, NONE) == ()


def test_more_time_buys_larger_photos_and_more_gaussians(photos_of_scene):
    assert sized(photos_of_scene.small, 128) == (32, 48)  # photos are never enlarged
    photos_of_scene.small.stored_size = lambda frame: (720, 1280)
    budget = Budget(0.01, (128, 128), photos_of_scene, Options())
    given = [*map(budget.affordable, (1, 120, 1200, 1e9))]
    assert given == sorted({*given})
    assert given[::3] == [(96, 171), (720, 1280)]
    assert budget.count(given[0]) < budget.count(given[1])
    fixed = replace(budget, options=Options(size=(90, 160), gaussians=77))
    assert (fixed.affordable(1), fixed.count((9, 9))) == ((90, 160), 77)

    told, advice = budget.sentences(given[0], 9, 1)
    assert re.match("poses .* 9 s; 1 s .* 43 steps on photos of 96 x 171 .* twice as many", told)
    lacking = re.search(r"small; (\S+) minutes more would give 128 ", advice)[1]
    assert min(budget.affordable(5 + 60 * float(lacking))) == 128
    assert "the time would give photos" in next(budget.sentences(given[1], 9, 600))


def test_points_of_colmap_are_part_of_the_start(taken, photos_of_scene, photos, tmp_path):
    """Of a folder of scenes, one of which is a COLMAP model with a point at (0, 0, 5)."""
    shutil.copytree(photos, tmp_path / "other")
    write_colmap(tmp_path / "mine", taken, "text")
    of_colmap = ScenePhotos(str(tmp_path), Options(scene="mine"))
    world = photos_world(of_colmap)
    views = views_in(world, of_colmap.small, of_colmap.frames)
    found = photos_start(of_colmap.small, world, views, 100, 40)
    assert found.count == 41
    point = moved(found, world[0], 1 / world[1]).means[0, 0]
    assert torch.allclose(point, torch.tensor([0.0, 0, 5]), 0, 1e-4)
    found = photos_start(photos_of_scene.small, photos_world(photos_of_scene), views, 100, 40)
    assert found.count == TIMED


POINTS = [(1.0, 2.0, 3.5, 255, 0, 51), (-1.0, 0.25, 4.0, 0, 102, 255), (0.5, 0.5, 5.0, 10, 20, 30)]
TEXT = "# points\n" + "".join(f"7 {' '.join(map(str, row))} 0.5 1 7\n" for row in POINTS)
BINARY = struct.pack("<Q", 3) + b"".join(
    struct.pack("<Q3d3BdQ", n, *row, 0.5, n) + bytes(8 * n) for n, row in enumerate(POINTS)
)
"""Tracks of 0, 1 and 2 images."""


def test_points_of_a_model(tmp_path):
    folder = UPath(tmp_path)
    assert sparse_points(folder) is None
    (tmp_path / "transforms.json").write_text("{}")
    model = write_colmap(tmp_path, synthetic(tmp_path / "files"), "text") / "sparse/0"
    assert sparse_points(folder) is None  # the other format's cameras have another world
    (tmp_path / "transforms.json").unlink()
    (model / "points3D.txt").write_text("# no points\n")
    assert sparse_points(folder) is None
    expected = torch.tensor(POINTS).double()
    for name, content in (("txt", TEXT.encode()), ("bin", BINARY)):
        file = model / f"points3D.{name}"
        file.write_bytes(content)
        points, colors = sparse_points(folder)
        file.unlink()
        assert_close(points, expected[:, :3])
        assert_close(colors, expected[:, 3:] / 255)
    assert sparse_points(folder) is None
    for cut in (4, 40, -3):
        file.write_bytes(BINARY[:cut])
        must_refuse(r"points3D\.bin", sparse_points, folder)


def test_gaussians_are_as_large_as_the_gaps_between_points():
    world = torch.eye(4), torch.tensor(0.5)
    grid = torch.cartesian_prod(*[torch.arange(4.0).double()] * 3)
    found = from_points((grid, grid / 3), world, 64)
    assert torch.allclose(found.scales, torch.tensor(0.5))
    assert torch.allclose(found.colors, found.means / 1.5)
    assert from_points((grid, grid), world, 10).count == 10
    alone = from_points((grid[:1], grid[:1]), world, 10).scales
    assert 0 < alone.min() <= alone.max() < torch.inf
