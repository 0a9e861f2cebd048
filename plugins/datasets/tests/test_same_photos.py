"""Chunks that somebody else wrote, of photos that are there too."""

import io

import numpy as np
import pytest
import torch
from photo_formats import PHOTOS, opened, scene
from PIL import Image
from qgs_datasets.chunks import ChunksSource

from qgs.data.images import to_tensor

pytestmark = pytest.mark.skipif(
    not (PHOTOS / "desk").is_dir(), reason=f"no photos in {PHOTOS}; QGS_PHOTOS names their folder"
)


@pytest.mark.parametrize(
    ("name", "split", "key", "crop"),
    [
        # the crops (left, top, width, height) that were cut before resizing to 640 x 360
        ("mary_rose", "train", "mary_rose", (0, 112, 512, 288)),
        ("office_walk", "train", "office_walk_00", (0, 28, 540, 304)),
        ("office_walk", "train", "office_walk_01", (0, 28, 540, 304)),
        ("desk", "test", "desk", (0, 0, 1280, 720)),
    ],
)
def test_photos_and_cameras(name, split, key, crop):
    chunks = opened(PHOTOS / "re10k_format", (360, 640), ChunksSource)
    (chunk,) = [s for s in chunks.scenes(split) if s.name == key]
    source = scene(PHOTOS / name, format="nerfstudio")
    distance = (source.cameras.c2w[:, None] - chunk.cameras.c2w).abs().amax((-1, -2))
    nearest, frames = distance.min(0)
    assert nearest.max() <= 1e-5
    left, top, width, height = crop
    fx, fy, cx, cy = source.encoded(int(frames[0])).intrinsics
    x, y = 640 / width, 360 / height
    wanted = torch.tensor([fx * x, fy * y, (cx - left) * x, (cy - top) * y], dtype=torch.float64)
    assert (chunk.cameras.intrinsics[0] - wanted).abs().max() <= 1e-4
    for frame in range(0, len(chunk), 20):
        with Image.open(io.BytesIO(source.encoded(int(frames[frame])).data)) as image:
            cut = image.convert("RGB").crop((left, top, left + width, top + height))
        pixels = to_tensor(np.array(cut.resize((640, 360), Image.Resampling.LANCZOS))[None])
        difference = (chunk.images([frame]) - pixels).abs().mean() * 255
        assert difference < 4  # of 255: JPEG, written again
