"""A reconstruction filmed from its folder by `qgs video`."""

import json

import numpy as np
import torch
from commands import done, run_qgs
from photo_formats import noisy_photos, row_of_frames
from qgs_photos.poses.paths import read_path
from training_runs import tiny
from walked import frames

import qgs
from qgs.cli.options import scale_settings
from qgs.reconstruction.reconstruct import reconstruct
from qgs.types import Cameras


def test_a_film_that_cannot_be_written_is_refused_at_once(tmp_path):
    """The reconstruction does not exist, which is found out later."""
    phone = tmp_path / "phone.mp4"
    phone.write_bytes(b"mine")
    for film, error in (("phone.mp4", FileExistsError), ("a.gif", ValueError)):
        result = run_qgs("video", tmp_path / "none", "--out", tmp_path / film)
        assert type(result.exception) is error, film
    assert [*tmp_path.iterdir()] == [phone]
    assert phone.read_bytes() == b"mine"


def test_a_film_shows_what_the_reconstruction_renders_of_the_photos_world(tmp_path):
    model = tiny("tokengs", "model.renderer.background=[0, 0, 0]").build_model()
    for weights in model.parameters():  # a fresh one draws all Gaussians alike
        weights.data += 0.02 * torch.randn_like(weights)
    checkpoint = tmp_path / "checkpoint.safetensors"
    qgs.save(model, checkpoint)
    photos = noisy_photos(tmp_path / "row")
    path = tmp_path / "path.json"  # what is seen lies small before the photos' cameras
    listed = row_of_frames(2, 0.2, fl_x=20, w=24, h=20)
    for frame in listed["frames"]:
        frame["transform_matrix"][2][3] = -0.38
    path.write_text(json.dumps(listed))
    film = tmp_path / "film.mp4"
    made = tmp_path / "made"
    done("reconstruct", checkpoint, photos, "--out", made, "--inputs", 2, "--scale", 2)
    done("video", made, "--out", film, "--path", path)

    scene = reconstruct(qgs.load(checkpoint), photos, inputs=2, overrides=scale_settings(2.0))
    c2w, lens = read_path(path, (480, 480), None)
    rendered = scene.render(Cameras(c2w[None], lens[None], (480, 480))).rgb[0]
    expected = 255 * rendered.clamp(0, 1).permute(0, 2, 3, 1).numpy()
    assert np.abs(expected[0] - expected[1]).mean() > 0.05 * 255
    assert np.shape(frames(film)) == expected.shape
    assert np.abs(frames(film) - expected).mean((1, 2, 3)).max() < 0.01 * 255
