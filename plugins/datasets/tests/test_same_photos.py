"""The same photos through every format that holds them."""

import io
import zipfile

import numpy as np
import pytest
import torch
from photo_formats import PHOTOS, opened
from PIL import Image
from qgs_datasets.chunks import ChunksSource
from qgs_datasets.dl3dv import Dl3dvSource
from qgs_datatools import packing
from upath import UPath

from qgs.data.images import to_tensor
from qgs.data.scenes import EncodedScene

pytestmark = pytest.mark.skipif(
    not (PHOTOS / "desk").is_dir(), reason=f"no photos in {PHOTOS}; QGS_PHOTOS names their folder"
)
SIZE = (144, 256)


def photos(name):
    return opened(PHOTOS / name, SIZE, format="nerfstudio")


def as_chunks(name, folder):
    source = photos(name)
    packing.pack(source, packing.own_splits(source), UPath(folder), {})
    return opened(folder, SIZE, ChunksSource).scenes("train")[0]


def as_archive(name, folder):
    with zipfile.ZipFile(folder / f"{name}.zip", "w") as archive:
        for file in (PHOTOS / name).rglob("*"):
            archive.write(file, file.relative_to(PHOTOS))
    return opened(folder, SIZE, Dl3dvSource, holdout=8).scenes("train")[0]


@pytest.mark.parametrize("read", [as_chunks, as_archive])
@pytest.mark.parametrize("name", ["mary_rose", "office_walk", "desk"])
def test_pixels_masks_intrinsics_and_poses(tmp_path, name, read):
    before, after = photos(name).scenes("train")[0], read(name, tmp_path)
    frames = range(0, len(before), 9)
    assert len(before) == len(after)
    assert tuple(before.held_out) == tuple(after.held_out)
    assert torch.equal(before.images(frames), after.images(frames))
    masks, same = before.masks(frames), after.masks(frames)
    assert same is None if masks is None else torch.equal(masks, same)
    difference = (before.cameras.intrinsics - after.cameras.intrinsics).abs().max()
    assert difference <= 1e-4  # pixels
    assert (before.cameras.c2w - after.cameras.c2w).abs().max() <= 1e-5


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
def test_chunks_that_somebody_else_wrote(name, split, key, crop):
    chunks = opened(PHOTOS / "re10k_format", (360, 640), ChunksSource)
    (chunk,) = [s for s in chunks.scenes(split) if s.name == key]
    source = photos(name).scenes("train")[0]
    assert isinstance(source, EncodedScene)
    distance = (source.cameras.c2w[:, None] - chunk.cameras.c2w).abs().amax((-1, -2))
    nearest, frames = distance.min(0)
    assert nearest.max() <= 1e-5
    left, top, width, height = crop
    fx, fy, cx, cy = source.encoded(int(frames[0])).intrinsics
    x, y = 640 / width, 360 / height
    wanted = torch.tensor([fx * x, fy * y, (cx - left) * x, (cy - top) * y], dtype=torch.float64)
    assert (chunk.cameras.intrinsics[0] - wanted).abs().max() <= 1e-4
    for frame in range(0, len(chunk), 20):
        pixels = cropped(source, int(frames[frame]), crop)
        difference = (chunk.images([frame]) - pixels).abs().mean() * 255
        assert difference < 4  # of 255: JPEG, written again


def cropped(scene, frame, crop):
    left, top, width, height = crop
    with Image.open(io.BytesIO(scene.encoded(frame).data)) as image:
        cut = image.convert("RGB").crop((left, top, left + width, top + height))
    return to_tensor(np.array(cut.resize((640, 360), Image.Resampling.LANCZOS))[None])
