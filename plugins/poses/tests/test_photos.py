"""Photos made ready: their order and names, and that the user's files stay as they are."""

import os

import numpy as np
import pytest
from PIL import Image
from qgs_poses.photos import photo_files, prepare


@pytest.fixture
def folders(tmp_path):
    """Of photos, of those that are kept, and of those for COLMAP."""
    folders = [tmp_path / name for name in ("photos", "kept", "small")]
    for folder in folders:
        folder.mkdir()
    return folders


def write(path, level: int, size: tuple[int, int] = (80, 100)) -> None:
    Image.fromarray(np.full((*size, 3), level, np.uint8)).save(path)


@pytest.mark.parametrize(("form", "same"), [("IMG {}.png", False), ("{:03}.png", True)])
def test_photos_are_in_the_order_of_their_numbers_and_so_are_their_names_as_text(
    form, same, folders
):
    photos, kept, small = folders
    for number in range(1, 13):
        write(photos / form.format(number), 10 * number)
    (ready, faulty) = prepare(photo_files(photos), kept, small, 1000)
    assert not faulty
    names = [photo.name for photo in ready]
    assert names == sorted(names)
    assert [round(float(photo.thumb.mean())) for photo in ready] == [10 * n for n in range(1, 13)]
    assert {file.name for file in kept.iterdir()} == {file.name for file in small.iterdir()}
    assert ({*names} == {file.name for file in photos.iterdir()}) == same


def test_a_file_of_the_user_that_was_linked_is_not_written_onto(folders):
    photos, kept, small = folders
    for number in range(3):
        write(photos / f"{number}.png", 90)
        before = (photos / f"{number}.png").read_bytes()
        os.link(photos / f"{number}.png", small / f"{number}.png")
    prepare(photo_files(photos), kept, small, 70)  # smaller copies of what is there
    assert Image.open(small / "0.png").size == (70, 56)
    assert all(file.read_bytes() == before for file in photos.iterdir())
