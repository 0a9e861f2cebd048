"""What `qgs eval` and `qgs reconstruct` say beside their numbers, in plain sentences."""

import csv
import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from commands import MODEL, run_qgs
from photo_formats import row_of_frames
from PIL import Image

import qgs
from qgs.composer import resolve
from qgs.data.domain import KEY, trained_domain

FRAMING = "(20% is cut off)"
NEAREST = "result is worse than the nearest photo, copied: PSNR "
OUTSIDE = "the views lie outside what this model was trained on"
WITHIN = "the cameras lie within what this model was trained on"

evaluated = partial(run_qgs, "eval")


@pytest.fixture(scope="module")
def photos(tmp_path_factory) -> Path:
    """Nine photos of 20 x 16 pixels, alike but for a little noise, taken along a line."""
    folder = tmp_path_factory.mktemp("photos")
    (folder / "images").mkdir()
    rng = np.random.default_rng(0)
    for index in range(9):
        pixels = (np.full((16, 20, 3), 90) + rng.integers(0, 9, (16, 20, 3))).astype(np.uint8)
        Image.fromarray(pixels).save(folder / "images" / f"IMG_{index + 1}.png")
    frames = row_of_frames(9, step=0.1, fl_x=20, fl_y=20, cx=10, cy=8, w=20, h=16)
    for index, frame in enumerate(frames["frames"]):
        frame["file_path"] = f"images/IMG_{index + 1}.png"
    (folder / "transforms.json").write_text(json.dumps(frames))
    return folder


@pytest.fixture(scope="module")
def checkpoint(photos: Path, tmp_path_factory) -> Path:
    """A model of these photos whose Gaussians are as large as they can be."""
    recipe = {
        "recipe": 1,
        "model": MODEL,
        "data": {"type": "qgs/photos", "path": str(photos), "image_size": [16, 16], "holdout": 3},
        "views": {"inputs": 2, "targets": 2, "gap": [2, 4], "scale": "constant"},
    }
    resolved = resolve(recipe)
    model = resolved.build_model()
    with torch.no_grad():
        model.head.linear.bias.unflatten(0, (-1, 14))[:, 6:9] = 5.0
    domain = trained_domain(resolved.build_data(), resolved.views, 0)
    file = tmp_path_factory.mktemp("run") / "checkpoint.safetensors"
    qgs.save(model, file, extra={KEY: domain.text})
    return file


def test_an_evaluation_says_what_it_judged_and_what_came_of_it(checkpoint: Path) -> None:
    result = evaluated(checkpoint)
    assert result.exit_code == 0, result.output
    said = ("frame 0 (images/IMG_1.png), 20 x 16 pixels", FRAMING, NEAREST, WITHIN)
    for words in said:
        assert result.output.count(words) == 1, words
    folder = checkpoint.parent / "evaluation"
    remarks = json.loads((folder / "summary.json").read_text())["remarks"]
    assert all(any(words in remark for remark in remarks) for words in said)
    assert "changed nothing" not in result.output
    (row,) = csv.DictReader((folder / "scenes.csv").open())
    assert row["input_frames"].split("; ")[0] == "0 6"
    assert row["input_names"].split("; ")[0] == "images/IMG_1.png, images/IMG_7.png"
    assert row["target_names"].split("; ")[0] == "images/IMG_2.png, images/IMG_5.png"


def test_a_reconstruction_says_the_same(checkpoint: Path, photos: Path, tmp_path: Path) -> None:
    more = ("--frames", "0,8", "--refine", 0.01)
    result = run_qgs("reconstruct", checkpoint, photos, "--out", tmp_path, *more)
    assert result.exit_code == 0, result.output
    remarks = json.loads((tmp_path / "cameras.json").read_text())["remarks"]
    for words in (FRAMING, NEAREST, OUTSIDE):
        assert words in result.output
        assert any(words in remark for remark in remarks)
    (remark,) = json.loads((tmp_path / "refined/cameras.json").read_text())["remarks"]
    assert NEAREST in remark
    assert remark in result.output
