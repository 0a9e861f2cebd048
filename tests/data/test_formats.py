"""The same photos through every format: the same pixels, intrinsics and poses."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from photo_formats import (
    centred,
    opened,
    scene,
    synthetic,
    uploaded,
    write_blender,
    write_colmap,
    write_llff,
    write_nerfstudio,
)
from PIL import Image
from pydantic import ValidationError
from tables import assert_equal, must_not_find, must_refuse
from upath import UPath

from qgs.data import PhotosSource
from qgs.data import photos as formats
from qgs.data.photos.reader import GROUP
from qgs.drawing.images import rgb_picture


def assert_same(read, photos):
    assert_equal(read.cameras.c2w, torch.from_numpy(photos.c2w), atol=1e-9)
    expected = [photos.intrinsics] * len(photos.files)
    assert_allclose(read.cameras.intrinsics, expected, rtol=0, atol=1e-9)
    for i, file in enumerate(photos.files):
        assert Path(read.frame_name(i)).stem == file.stem
        assert np.array_equal(rgb_picture(read.images([i])[0]), Image.open(file))


def test_the_same_photos_in_every_format(tmp_path):
    """LLFF and Blender know square pixels and a principal point in the middle alone."""
    photos = synthetic(tmp_path / "photos")
    square = centred(photos)
    for folder, written in (
        (write_nerfstudio(tmp_path / "nerfstudio", photos), photos),
        (write_colmap(tmp_path / "text", photos, "text"), photos),
        (write_colmap(tmp_path / "binary", photos, "binary", model="sparse"), photos),
        (write_llff(tmp_path / "llff", square), square),
        (write_blender(tmp_path / "blender", square, 6), square),
    ):
        assert_same(scene(folder), written)


def test_what_a_folder_holds_most_is_read_in_a_told_order(tmp_path, caplog):
    photos = centred(synthetic(tmp_path / "photos"))
    write_llff(tmp_path, photos)
    write_colmap(tmp_path, photos, "text")
    assert_same(scene(tmp_path), photos)
    assert "(colmap, llff) and is read as colmap; set data.format" in caplog.text
    must_not_find(r"transforms\.json", scene, tmp_path, format="nerfstudio")


@pytest.mark.parametrize("write", [write_llff, write_nerfstudio, write_colmap])
def test_scaled_copies(tmp_path, write):
    """Copies are read where asked for, and where they are all there is."""
    photos = centred(synthetic(tmp_path / "photos", size=(40, 80)))
    write(tmp_path, photos, *(["binary"] if write is write_colmap else []))
    (tmp_path / "images_4").mkdir()
    for file in photos.files:
        Image.open(file).resize((20, 10)).save(tmp_path / "images_4" / file.name)
    expected = torch.tensor([12.5, 12.5, 10, 5]).double()

    def reads(folder, images=None):
        read = scene(tmp_path, (10, 20), images=images)
        assert read.frame_name(2) == f"{folder}/view_002.png"
        torch.testing.assert_close(read.cameras.intrinsics[0], expected)

    reads("images")
    reads("images_4", "images_4")
    shutil.rmtree(tmp_path / "images")
    reads("images_4")
    must_not_find("images_3", scene, tmp_path, images="images_3")


def test_a_folder_of_scenes(tmp_path, caplog):
    for i, name in enumerate(("b", "a")):
        write_nerfstudio(tmp_path / name, synthetic(tmp_path / "photos" / name, seed=i))
    (tmp_path / "notes").mkdir()
    source = opened(tmp_path)
    assert source.names("train") == ["a", "b"]
    assert "no photos with cameras: notes, photos" in caplog.text
    assert source.scenes("test")[0].held_out == (3,)
    assert not torch.equal(*(s.images([0]) for s in source.scenes("train")))


def test_scenes_split_by_folder(tmp_path):
    for name in ("train/a", "train/b", "test/c"):
        write_llff(tmp_path / name, synthetic(tmp_path / "photos"))
    (tmp_path / "train/b/images/view_001.png").unlink()
    source = opened(tmp_path)
    assert [len(source.scenes(split)) for split in ("train", "test")] == [2, 1]
    assert source.scenes("test")[0].name == "c"
    must_refuse("6 poses, but .*images has 5 images", source.scenes("train").__getitem__, 1)


CSV = """
import numpy as np
from qgs.data.photos.reader import Listing, PhotoFrame, PhotoReader


class Csv(PhotoReader):
    name, listing, poses = "csv", "poses.csv", "opencv"

    @classmethod
    def read(cls, folder, images):
        frames = []
        for line in (folder / cls.listing).read_text().splitlines():
            name, *values = line.split(",")
            fx, fy, cx, cy, *pose = map(float, values)
            c2w = np.array(pose).reshape(4, 4)
            frames.append(PhotoFrame(name, folder / name, c2w, (fx, fy, cx, cy)))
        return Listing(folder / cls.listing, frames)


plugin = Csv
"""


def test_a_distribution_adds_a_format(install, tmp_path, caplog):
    must_refuse("csv", PhotosSource.Config, path="photos", format="csv", kind=ValidationError)
    for name, source in (("csv", CSV), ("nerfstudio", CSV), ("none", "")):
        install(f"{name}-photos", name, source, group=GROUP)
    assert PhotosSource.Config(path="photos", format="csv").format == "csv"
    (folder := UPath(tmp_path / "photos")).mkdir()
    must_not_find(r"transforms\.json.*poses\.csv \(csv\)", formats.read_listing, folder)
    photos = synthetic(tmp_path / "photos", count=2)
    lines = [
        ",".join(map(str, [file.name, *photos.intrinsics, *pose.flatten().tolist()]))
        for file, pose in zip(photos.files, photos.c2w, strict=True)
    ]
    (folder / "poses.csv").write_text("\n".join(lines))
    assert formats.formats_of(folder) == ["csv"]
    assert formats.read_listing(folder).file.name == "poses.csv"
    assert_same(scene(folder, format="csv"), photos)
    own = formats.readers()["nerfstudio"]
    assert own is formats.Nerfstudio, "installing changes no other format"
    assert "none-photos 1.2" in caplog.text, "what cannot be loaded is logged with its distribution"


def test_photos_in_memory_and_in_archives(tmp_path):
    photos = synthetic(tmp_path / "photos")
    write_colmap(tmp_path / "a", photos, "binary")
    uploaded(tmp_path / "a", UPath("memory://photos/a"))
    shutil.make_archive(str(tmp_path / "a"), "zip", tmp_path, "a")
    expected = scene(tmp_path / "a").images(range(6))
    for url in ("memory://photos/a", f"zip://a::file://{tmp_path}/a.zip"):
        assert_allclose(scene(url).cameras.c2w, photos.c2w, atol=1e-6)
        assert_equal(scene(url).images(range(6)), expected)
