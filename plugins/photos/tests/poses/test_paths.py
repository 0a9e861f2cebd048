"""Camera paths, what they are filmed of, and the files that come of it."""

import math

import av
import numpy as np
import pytest
import torch
from commands import done, run_qgs
from photo_formats import noisy_photos, row_of_frames
from PIL import Image, ImageSequence
from qgs_photos.poses.filming import FilmScene, cameras_of, open_film_scene, seen_depth, write_film
from qgs_photos.poses.paths import path_of, read_path, walk
from qgs_photos.viewing import VIEWER
from small_parts import shaken
from tables import assert_near, must_not_find, must_refuse, write_json
from training_runs import tiny
from walk import along_x, assert_rigid, cloud, pinhole
from walked import frames

import qgs
from qgs.cli.options import scale_settings
from qgs.geometry.transforms import moved
from qgs.reconstruction.reconstruct import reconstruct
from qgs.reconstruction.scene_formats import save_ply

SIZE = (36, 54)


def cameras():
    """A row of cameras that looks along z."""
    return pinhole(along_x(torch.linspace(-0.5, 0.5, 7)), size=SIZE)[None]


def wall(depth):
    """Coloured Gaussians (1, 400) on a plane z = depth."""
    gaussians = cloud(400)
    flat = gaussians.means * torch.tensor([4, 4, 0]) + torch.tensor([0, 0, depth])
    return gaussians.replace(means=flat)


def test_paths_are_rigid_and_take_small_steps():
    c2w = torch.stack([path_of(kind, cameras(), 3.0, 40) for kind in ("orbit", "spiral", "walk")])
    assert_rigid(c2w)
    assert c2w[..., :3, 3].diff(dim=1).norm(dim=-1).max() < 0.15


def test_a_spiral_looks_at_one_point_and_a_walk_goes_from_the_first_photo_to_the_last():
    path = path_of("spiral", cameras(), 3.0, 40)
    away = torch.tensor([0.0, 0, 3]) - path[:, :3, 3]
    assert torch.linalg.cross(away, path[:, :3, 2]).norm(dim=-1).max() < 1e-5
    start, end = walk(cameras().c2w[0], 30)[[0, -1], 0, 3]
    assert start < -0.3 < 0.3 < end


def test_camera_paths_in_files_are_read(tmp_path):
    """Those of nerfstudio's viewer, and transforms."""
    pose = [[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    entry = f'{{"camera_to_world": {np.ravel(pose).tolist()}, "fov": 90, "aspect": 1.5}}'
    frame = f'{{"file_path": "a.png", "transform_matrix": {pose}}}'
    expected = torch.tensor(pose) * torch.tensor([1.0, -1, -1, 1])
    file = tmp_path / "transforms.json"
    for content, focal in (
        (f'{{"camera_path": [{entry}, {entry}], "fps": 24}}', 50),
        (f'{{"fl_x": 80, "w": 75, "h": 50, "frames": [{frame}, {frame}]}}', 160),
    ):
        file.write_text(content)
        c2w, found = read_path(file, (100, 150))
        assert c2w.tolist() == [expected.tolist()] * 2
        assert_near(found, [[focal, focal]] * 2)


def test_a_file_that_is_no_path_is_refused(tmp_path):
    lens = '{"fl_x": 9, "w": 9, "h": 9, "frames": [{"file_path": "a", "transform_matrix": '
    file = tmp_path / "path.json"
    for content in (
        "{",
        "{}",
        "[1]",
        '{"frames": []}',
        '{"camera_path": [{"camera_to_world": [1, 2]}]}',
        lens + "[1, 2]}]}",
        lens.replace('"w": 9, "h": 9, ', "") + "[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]}]}",
    ):
        file.write_text(content)
        must_refuse("path.json is not a camera path", read_path, file, SIZE)


def test_size_length_and_angle_of_view():
    world = torch.eye(4).double(), 1.0
    scene = FilmScene(wall(3.0), cameras(), VIEWER, world)
    assert_near(seen_depth(scene), 3.0, rtol=0.02)
    path = cameras_of(scene, "orbit", None, 5, None)
    assert path.shape == (1, 5)
    assert path.size == (480, 720)
    path = cameras_of(scene, "spiral", (100, 200), 5, 60)
    focal = 50 / math.tan(math.radians(30))
    assert_near(path.intrinsics[0, 0], [focal, focal, 100, 50])


def test_a_film_shows_the_pictures(tmp_path):
    levels = [20, 60, 100, 140, 180]
    mp4 = tmp_path / "film.mp4"
    webp = tmp_path / "film.webp"
    for file in (mp4, webp):
        write_film((np.full((31, 48, 3), level, np.uint8) for level in levels), file, 12)
    with av.open(str(mp4)) as container:
        assert container.streams.video[0].codec_context.name == "h264"
    of_mp4 = frames(mp4)
    assert of_mp4[0].shape == (30, 48, 3)
    of_webp = [np.array(frame.convert("RGB")) for frame in ImageSequence.Iterator(Image.open(webp))]
    for found in (of_mp4, of_webp):
        assert [frame.mean() for frame in found] == pytest.approx(levels, abs=3)


def test_a_scene_of_photos_is_filmed_from_their_cameras(made, tmp_path):
    """What is rendered in the film's world is what the photos' world shows."""
    views = qgs.read_photos(made[0])
    gaussians = moved(wall(1.5), views.cameras.c2w[0, 0], 1.0)
    save_ply(gaussians, tmp_path / "scene.ply")
    opened = open_film_scene(tmp_path / "scene.ply", str(made[0]), None)
    found = VIEWER(opened.gaussians, opened.cameras[:, 2:3]).rgb
    expected = VIEWER(gaussians, views.cameras.to(torch.float32)[:, 2:3]).rgb
    assert torch.allclose(found, expected, 0, 0.02)


def test_the_command_films(made, here):
    save_ply(wall(3.0), "scene.ply")
    film = f". {made[0]} --out a.mp4 --path walk --seconds 0.4 --rate 5 --size 32x48"
    done(f"video {film}")
    assert len(frames("a.mp4")) == 2
    walks = film.replace("a.mp4", "b.mp4").replace("walk", "walks")
    must_not_find(None, done, "video nothing")
    for refused in (".", walks):
        must_refuse(None, done, f"video {refused}")


def test_a_film_that_cannot_be_written_is_refused_at_once(tmp_path):
    """The reconstruction does not exist, which is found out later."""
    phone = tmp_path / "phone.mp4"
    phone.write_bytes(b"mine")
    for film, error in (("phone.mp4", FileExistsError), ("a.gif", ValueError)):
        result = run_qgs(f"video {tmp_path}/none --out {tmp_path}/{film}")
        assert type(result.exception) is error, film
    assert [*tmp_path.iterdir()] == [phone]
    assert phone.read_bytes() == b"mine"


def test_a_film_shows_what_the_reconstruction_renders_of_the_photos_world(here):
    model = tiny("tokengs", "model.renderer.background=[0, 0, 0]").build_model()
    checkpoint = "checkpoint.safetensors"
    qgs.save(shaken(model, 0.02).float(), checkpoint)  # a fresh one draws all Gaussians alike
    photos = noisy_photos(here / "row")
    path = here / "path.json"  # what is seen lies small before the photos' cameras
    listed = row_of_frames(2, 0.2, fl_x=20, w=24, h=20)
    for frame in listed["frames"]:
        frame["transform_matrix"][2][3] = -0.38
    write_json(path, listed)
    done(f"reconstruct {checkpoint} {photos} --out made --inputs 2 --scale 2")
    done("video made --out film.mp4 --path path.json")
    shown = frames("film.mp4")

    scene = reconstruct(qgs.load(checkpoint), photos, inputs=2, overrides=scale_settings(2.0))
    c2w, focal = read_path(path, (480, 480))
    rendered = scene.render(pinhole(c2w, (*focal[0], 240, 240), (480, 480))[None]).rgb[0]
    expected = 255 * rendered.clamp(0, 1).permute(0, 2, 3, 1).numpy()
    assert np.abs(expected[0] - expected[1]).mean() > 0.05 * 255
    assert np.shape(shown) == expected.shape
    assert np.abs(shown - expected).mean((1, 2, 3)).max() < 0.01 * 255
