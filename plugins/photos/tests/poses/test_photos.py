"""Photos made ready: their order and names, and that the user's files stay as they are."""

import os

import numpy as np
import pytest
from PIL import Image
from qgs_photos.poses.photos import camera_groups, photo_files, prepare
from walked import write_photos


@pytest.fixture
def folders(tmp_path):
    """Of photos, of those that are kept, and of those for COLMAP."""
    folders = [tmp_path / name for name in ("images", "kept", "small")]
    for folder in folders:
        folder.mkdir()
    return folders


def test_photos_are_in_the_order_of_their_numbers_and_so_are_their_names_as_text(folders):
    photos, kept, small = folders
    images = [np.full((80, 100, 3), 10 * number, np.uint8) for number in range(12)]
    write_photos(photos, images, "IMG {}.png")
    ready, faulty = prepare(photo_files(photos), kept, small, 1000)
    assert not faulty
    names = [f"{number:02}_IMG {number}.png" for number in range(12)]
    assert [photo.name for photo in ready] == names
    for folder in (kept, small):
        assert np.array_equal([np.array(Image.open(folder / name)) for name in names], images)


def test_files_of_the_user_are_linked_or_copied(folders, monkeypatch):
    photos, kept, small = folders
    write_photos(photos, np.full((3, 80, 100, 3), 90, np.uint8))
    files = photo_files(photos.parent)  # in a folder `images`
    prepare(files, kept, small, 70)
    assert Image.open(small / "0.png").size == (70, 56)
    assert files[0].samefile(kept / "0.png")

    def refused(*rest):
        raise OSError(18, "Invalid cross-device link")

    monkeypatch.setattr(os, "link", refused)
    (kept / "0.png").unlink()
    prepare(files[:1], kept, small, 70)
    assert not files[0].samefile(kept / "0.png")
    assert (kept / "0.png").read_bytes() == files[0].read_bytes()


def test_photos_of_one_size_and_focal_length_share_a_camera(folders):
    photos, kept, small = folders
    for name, focal, width in (
        ("a", 25.0, 100),
        ("b", 50.0, 100),
        ("c", 25.0, 100),
        ("d", 25.0, 90),
    ):
        exif = Image.Exif()
        exif.get_ifd(0x8769)[0x920A] = focal
        Image.new("RGB", (width, 80)).save(photos / f"{name}.jpg", exif=exif)
    damaged = b"Exif\0\0MM\0*\0\0\0\x08\xff\xff" + bytes(30)
    Image.new("RGB", (100, 80)).save(photos / "e.jpg", exif=damaged)
    ready, _ = prepare(photo_files(photos), kept, small, 1000)
    assert camera_groups(ready) == [["a.jpg", "c.jpg"], ["b.jpg"], ["d.jpg"], ["e.jpg"]]
