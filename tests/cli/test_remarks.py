"""What `qgs eval` writes beside its numbers: names of photos, and what a user must know."""

import csv
import json

import numpy as np
import torch
from commands import MODEL, run_qgs
from photo_formats import row_of_frames
from PIL import Image

import qgs
from qgs.composer import resolve
from qgs.data.domain import KEY
from qgs.data.stream import trained_domain


def test_an_evaluation_names_its_photos_and_says_where_a_copy_is_better(tmp_path):
    """Of photos alike but for a little noise, and Gaussians as large as they can be."""
    (tmp_path / "images").mkdir()
    rng = np.random.default_rng(0)
    frames = row_of_frames(9, step=0.1, fl_x=20, fl_y=20, cx=10, cy=8, w=20, h=16)
    for index, frame in enumerate(frames["frames"]):
        frame["file_path"] = f"images/IMG_{index + 1}.png"
        pixels = (np.full((16, 20, 3), 90) + rng.integers(0, 9, (16, 20, 3))).astype(np.uint8)
        Image.fromarray(pixels).save(tmp_path / frame["file_path"])
    (tmp_path / "transforms.json").write_text(json.dumps(frames))
    data = {"type": "qgs/photos", "path": str(tmp_path), "image_size": [16, 16], "holdout": 3}
    views = {"inputs": 2, "targets": 2, "gap": [2, 4], "scale": "constant"}
    recipe = resolve({"recipe": 1, "model": MODEL, "data": data, "views": views})
    model = recipe.build_model()
    with torch.no_grad():
        model.head.linear.bias.unflatten(0, (-1, 14))[:, 6:9] = 5.0
    domain = trained_domain(recipe.build_data(), recipe.views, 0)
    qgs.save(model, tmp_path / "run" / "checkpoint.safetensors", extra={KEY: domain.text})
    assert run_qgs("eval", tmp_path / "run").exit_code == 0
    folder = tmp_path / "run" / "evaluation"
    remarks = json.loads((folder / "summary.json").read_text())["remarks"]
    for word in ("20% is cut off", "worse than the nearest", "within"):
        assert sum(word in remark for remark in remarks) == 1, word
    (row,) = csv.DictReader((folder / "scenes.csv").open())
    assert row["input_frames"].split("; ")[0] == "0 6"
    assert row["input_names"].split("; ")[0] == "images/IMG_1.png, images/IMG_7.png"
    assert row["target_names"].split("; ")[0] == "images/IMG_2.png, images/IMG_5.png"
