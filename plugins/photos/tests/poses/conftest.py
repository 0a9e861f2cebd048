"""A textured room, photographed while walking, and the poses that COLMAP finds of it."""

import numpy as np
import pytest
import textured_room
from photo_formats import cut, noise, turned
from PIL import Image
from qgs_photos.poses.making import Options, make_poses
from walked import PHOTOS, QUIET, SCALE


@pytest.fixture(scope="session")
def shots():
    return textured_room.walk(PHOTOS, SCALE)


@pytest.fixture(scope="session")
def images(shots):
    return [shot.image for shot in shots]


@pytest.fixture(scope="session")
def walk(images, tmp_path_factory):
    """Photos of every kind, of which one shows something else, among files that are none."""
    folder = tmp_path_factory.mktemp("walk") / "Küche und Flur"
    folder.mkdir()
    photos = [*map(Image.fromarray, images)]
    photos[0].save(folder / "0 Fo’to #{} %20 'ä'.JPG", quality=95)
    stored = photos[1].transpose(Image.Transpose.ROTATE_90)
    stored.save(folder / "1.jpg", quality=95, exif=turned(6))  # upright by a quarter turn
    Image.fromarray(257 * np.array(photos[2].convert("L"), np.uint16)).save(folder / "2.png")
    photos[3].convert("CMYK").save(folder / "3.tif")
    photos[4].save(folder / "4.avif", quality=95)
    photos[5].convert("RGBA").save(folder.parent / "5.png")
    (folder / "5.png").symlink_to(folder.parent / "5.png")
    other = Image.fromarray(noise(*images[0].shape, seed=7))
    other.save(folder / "other.png")
    other.save(folder / "broken.png")
    cut(folder / "broken.png", 0.5)
    for name in ("empty.jpg", "a.DNG", "._0.jpg"):
        (folder / name).touch()
    (folder / "folder.jpg").mkdir()
    return folder


@pytest.fixture(scope="session")
def made(walk, tmp_path_factory):
    """A folder, and its poses, of copies of the photos that are smaller than they are."""
    folder = tmp_path_factory.mktemp("made") / "poses"
    return folder, make_poses(walk, folder, Options(side=240), QUIET)
