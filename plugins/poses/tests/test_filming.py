"""A reconstruction filmed by --video, and again from its folder by `qgs video`."""

import json

import av
import numpy as np
import pytest
import torch
from commands import MODEL, run_qgs
from photo_formats import noisy_photos
from qgs_poses.paths import read_path

import qgs
from qgs.analysis.scenes import reconstruct
from qgs.cli.options import scale_settings
from qgs.types import Cameras

RECIPE = {
    "recipe": 1,
    "model": {**MODEL, "renderer": {"background": [0, 0, 0]}},
    "plugins": ["rooms"],
    "data": {"type": "rooms/procedural", "image_size": [16, 16]},
    "views": {"inputs": 2, "targets": 2, "gap": [2, 4], "scale": "constant"},
}


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    path = tmp_path_factory.mktemp("run") / "checkpoint.safetensors"
    model = qgs.compose(RECIPE)
    torch.manual_seed(0)
    for weights in model.parameters():  # a fresh one draws all Gaussians alike
        weights.data += 0.02 * torch.randn_like(weights)
    qgs.save(model, path)
    return path


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    return noisy_photos(tmp_path_factory.mktemp("photos") / "row")


@pytest.mark.parametrize(
    ("name", "path", "error"),
    [
        ("phone.mp4", "orbit", FileExistsError),
        ("a.gif", "orbit", ValueError),
        ("a.mp4", "orbits", ValueError),
    ],
)
def test_a_film_that_cannot_be_written_is_refused_at_once(name, path, error, tmp_path):
    (tmp_path / "phone.mp4").write_bytes(b"mine")
    # the checkpoint does not exist, which is found out later
    result = run_qgs(
        "reconstruct", tmp_path / "none.safetensors", tmp_path / "phone.mp4",
        "--out", tmp_path / "made", "--video", tmp_path / name, "--path", path, "--overwrite",
    )  # fmt: skip
    assert type(result.exception) is error
    assert {f.name: f.read_bytes() for f in tmp_path.iterdir()} == {"phone.mp4": b"mine"}


def frames(file) -> np.ndarray:
    with av.open(str(file)) as container:
        pictures = [f.to_ndarray(format="rgb24") for f in container.decode(video=0)]
    return np.stack(pictures).astype(np.float32) / 255


def test_both_films_show_what_the_reconstruction_renders_of_the_photos_world(
    checkpoint, photos, tmp_path
):
    path = tmp_path / "path.json"  # what is seen lies small before the photos' cameras
    listed = json.loads((photos / "transforms.json").read_text())
    for frame in listed["frames"]:
        frame["transform_matrix"][2][3] -= 0.38
    path.write_text(json.dumps(listed))
    one, two, made = tmp_path / "one.mp4", tmp_path / "two.mp4", tmp_path / "made"
    words = [checkpoint, photos, "--out", made, "--inputs", "2", "--scale", "2"]
    result = run_qgs("reconstruct", *words, "--video", one, "--path", path)
    assert result.exit_code == 0, (result.output, result.exception)
    result = run_qgs("video", made, "--out", two, "--path", path)
    assert result.exit_code == 0, (result.output, result.exception)

    scene = reconstruct(qgs.load(checkpoint), photos, inputs=2, overrides=scale_settings(2.0))
    c2w, lens = read_path(path, (480, 480), None)
    rendered = scene.render(Cameras(c2w[None], lens[None], (480, 480))).rgb[0]
    expected = rendered.clamp(0, 1).permute(0, 2, 3, 1).numpy()
    assert np.abs(expected[2] - expected[3]).mean() > 0.05
    for film in (frames(one), frames(two)):
        assert film.shape == expected.shape
        assert np.abs(film - expected).mean((1, 2, 3)).max() < 0.01
