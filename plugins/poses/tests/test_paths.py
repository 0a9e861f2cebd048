"""Camera paths, what they are filmed of, and the files that come of it."""

import json
import math
from pathlib import Path

import av
import numpy as np
import pytest
import torch
from commands import run_qgs
from qgs_poses.film import write_film
from qgs_poses.filming import Shot, Stage, cameras_of, open_stage, seen_depth
from qgs_poses.paths import path_of, read_path, walk

from qgs.geometry.transforms import moved
from qgs.io.gaussians import save_ply
from qgs.renderers import AutoRenderer, TorchRenderer
from qgs.types import Cameras, Gaussians

SIZE = (36, 54)


def cameras(count: int = 7) -> Cameras:
    """A row of cameras that looks along z."""
    c2w = torch.eye(4).repeat(count, 1, 1)
    c2w[:, 0, 3] = torch.linspace(-0.5, 0.5, count)
    lens = torch.tensor([44.0, 44, 27, 18]).expand(1, count, 4)
    return Cameras(c2w[None], lens, SIZE)


def wall(depth: float, count: int = 400) -> Gaussians:
    """Coloured Gaussians (1, G) on a plane z = depth."""
    rng = torch.Generator().manual_seed(0)
    means = torch.rand(1, count, 3, generator=rng) * 4 - 2
    means[..., 2] = depth
    return Gaussians(
        means=means,
        scales=torch.full((1, count, 3), 0.15),
        quats=torch.tensor([1.0, 0, 0, 0]).expand(1, count, 4),
        opacities=torch.full((1, count), 0.9),
        colors=torch.rand(1, count, 3, generator=rng),
    )


def stage(depth: float = 3.0) -> Stage:
    world = torch.eye(4, dtype=torch.float64), 1.0
    return Stage(wall(depth), cameras(), AutoRenderer(AutoRenderer.Config()), world)


@pytest.mark.parametrize("kind", ["orbit", "spiral", "walk"])
def test_paths_are_rigid_and_end_near_where_they_began_or_went(kind):
    path = path_of(kind, cameras(), 3.0, 40)
    turn = path.c2w[0, :, :3, :3]
    torch.testing.assert_close(turn @ turn.mT, torch.eye(3).expand(40, 3, 3), atol=1e-5, rtol=0)
    torch.testing.assert_close(torch.linalg.det(turn), torch.ones(40))
    steps = path.c2w[0, :, :3, 3].diff(dim=0).norm(dim=-1)
    assert steps.max() < 0.15
    assert path.size == SIZE


def test_a_spiral_looks_at_one_point_and_a_walk_goes_from_the_first_photo_to_the_last():
    path = path_of("spiral", cameras(), 3.0, 40).c2w[0]
    point = torch.tensor([0.0, 0, 3])
    away = point - path[:, :3, 3]
    across = torch.linalg.cross(away, path[:, :3, 2]).norm(dim=-1)
    assert across.max() < 1e-5
    ends = walk(cameras().c2w[0], 30)[[0, -1], 0, 3]
    assert ends[0] < -0.3
    assert ends[1] > 0.3


def test_a_camera_path_of_nerfstudio_is_read(tmp_path):
    pose = np.eye(4)
    pose[:3, 3] = 1, 2, 3
    entry = {"camera_to_world": pose.flatten().tolist(), "fov": 90, "aspect": 1.5}
    file = tmp_path / "path.json"
    file.write_text(json.dumps({"camera_path": [entry, entry], "fps": 24}))
    c2w, lens = read_path(file, (100, 150), None)
    expected = torch.from_numpy(pose) * torch.tensor([1.0, -1, -1, 1]).double()
    torch.testing.assert_close(c2w, expected.expand(2, 4, 4))
    torch.testing.assert_close(lens, torch.tensor([50.0, 50, 75, 50]).double().expand(2, 4))
    (tmp_path / "transforms.json").write_text(
        json.dumps(
            {
                "fl_x": 80,
                "w": 75,
                "h": 50,
                "frames": [{"file_path": "a.png", "transform_matrix": pose.tolist()}],
            }
        )
    )
    c2w, lens = read_path(tmp_path / "transforms.json", (100, 150), None)
    torch.testing.assert_close(c2w, expected[None])
    assert lens[0, 0] == 160


@pytest.mark.parametrize(
    "content",
    [
        "{",
        "{}",
        "[1]",
        '{"frames": []}',
        '{"camera_path": [{"camera_to_world": [1, 2]}]}',
        '{"fl_x": 9, "w": 9, "h": 9, "frames": [{"file_path": "a", "transform_matrix": [1, 2]}]}',
        '{"fl_x": 9, "frames": [{"file_path": "a", "transform_matrix": '
        "[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]}]}",
    ],
)
def test_a_file_that_is_no_path_is_refused(content, tmp_path):
    (tmp_path / "path.json").write_text(content)
    with pytest.raises(ValueError, match=r"path\.json is no camera path"):
        read_path(tmp_path / "path.json", SIZE, None)


def test_size_length_and_angle_of_view():
    assert seen_depth(stage(3.0)) == pytest.approx(3.0, rel=0.02)
    path = cameras_of(stage(), Shot("orbit", seconds=0.5, rate=10))
    assert path.shape == (1, 5)
    assert path.size == (480, 720)
    path = cameras_of(stage(), Shot("spiral", (100, 200), 0.5, 10, fov=60))
    fx, fy, cx, cy = path.intrinsics[0, 0].tolist()
    assert (cx, cy) == (100, 50)
    assert fx == fy == pytest.approx(50 / math.tan(math.radians(30)))


@pytest.mark.parametrize("suffix", [".mp4", ".webp"])
def test_a_film_shows_the_pictures(suffix, tmp_path):
    pictures = [np.full((31, 48, 3), 20 + 40 * number, np.uint8) for number in range(5)]
    file = tmp_path / f"film{suffix}"
    write_film(iter(pictures), file, 12)
    if suffix == ".mp4":
        with av.open(str(file)) as container:
            assert container.streams.video[0].codec_context.name == "h264"
            found = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
        assert found[0].shape == (30, 48, 3)
    else:
        from PIL import Image, ImageSequence

        frames = ImageSequence.Iterator(Image.open(file))
        found = [np.array(frame.convert("RGB")) for frame in frames]
    assert [round(float(frame.mean())) for frame in found] == pytest.approx(
        [20, 60, 100, 140, 180], abs=3
    )


def test_a_scene_of_photos_is_filmed_from_their_cameras(made, tmp_path):
    """What is rendered in the stage's world is what the photos' world shows."""
    import qgs

    views = qgs.read_photos(made.folder, size=SIZE)
    pose = views.cameras.c2w[0, 0]
    gaussians = moved(wall(1.5), pose, 1.0)
    save_ply(gaussians, tmp_path / "scene.ply")
    opened = open_stage(tmp_path / "scene.ply", str(made.folder), None)
    renderer = TorchRenderer(TorchRenderer.Config())
    factor = opened.cameras.size[0] / SIZE[0]
    lens = opened.cameras.intrinsics[:, 2:3] / factor
    inside = Cameras(opened.cameras.c2w[:, 2:3], lens, SIZE)
    outside = Cameras(views.cameras.c2w[:, 2:3].float(), views.cameras.intrinsics[:, 2:3], SIZE)
    torch.testing.assert_close(
        renderer(opened.gaussians, inside).rgb, renderer(gaussians, outside).rgb,
        atol=0.02, rtol=0,
    )  # fmt: skip


def test_the_command_films_and_overwrites_nothing(made, tmp_path):
    save_ply(wall(3.0), tmp_path / "scene.ply")
    out = tmp_path / "a.mp4"
    words = ["video", tmp_path, made.folder, "--out", out, "--path", "walk"]
    words += ["--seconds", "0.4", "--rate", "5", "--size", "32x48"]
    result = run_qgs(*words)
    assert result.exit_code == 0, result.output
    with av.open(str(out)) as container:
        assert sum(1 for _ in container.decode(video=0)) == 2
    assert isinstance(run_qgs(*words).exception, FileExistsError)
    assert isinstance(run_qgs("video", tmp_path).exception, ValueError)
    assert isinstance(run_qgs("video", tmp_path, "--out", tmp_path / "a.gif").exception, ValueError)
    assert isinstance(run_qgs("video", Path("nothing")).exception, FileNotFoundError)
