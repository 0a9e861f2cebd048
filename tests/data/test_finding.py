"""Photos that lie elsewhere, or are called otherwise, than their listing says."""

import json

import pytest
from photo_formats import row_of_frames
from photo_formats import scene as read
from PIL import Image

from qgs.wording import warn_once

FOUND = """
images/N.png: images/N.png:
C\\Users\\me\\spoon\\images\\N.png: images/N.png: 3 in another folder
/data/me/spoon/images/N.png: images/N.png: 3 in another folder
/data/N.png: N.png: 3 in another folder
../spoon/images/N.png: images/N.png: 3 in another folder
images/N.png: N.png: 3 in another folder
N.png: images/N.png: 3 in another folder
images/images/N.png: images/N.png: 3 in another folder
images/cam\\N.png: cam/N.png: 3 in another folder
images/N.png: images_4/N.png:
images/N.png: Images/N.png: 3 in another folder
images/N.jpg: images/N.JPG: 3 with other letters or suffix
Images/viewN.png: images/VIEWN.png: 3 with other letters or suffix
images/zoe\u0301N.png: images/zo\u00e9N.png: 3 with other letters or suffix
images/N: images/N.jpg: 3 with other letters or suffix
images/N.jpeg: images/N.png: 3 with other letters or suffix
images/N.0: images/N.0.webp: 3 with other letters or suffix
D\\a\\N.webp: Images/N.jpg: 3 with other letters or suffix
"""
"""As listed, as the file is called, and what is told."""
REFUSED = """
names 3 images, but 0 exist: images/N.png: masks/N.png
names 3 images, but 1 exist: N/0.png: images/0.png
outside: /data/N.png: masks/N.png
may be any of: images/N.jpg: images/N.JPG images/N.Jpg
may be any of: images/N.webp: images/N.jpg images/N.png
"""
"""What is told, as listed, and as files are called."""


@pytest.fixture
def spoon(tmp_path):
    """Three photos of the names `files`, which are listed as `listed`."""
    warn_once.cache_clear()

    def made(name, listed, *files, **more):
        folder = tmp_path / name
        for number in "012":
            for file in files:
                path = folder / file.replace("N", number)
                path.parent.mkdir(parents=True, exist_ok=True)
                Image.new("RGB", (40, 30)).save(path)
        content = row_of_frames(3, fl_x=40, w=40, h=30)
        for number, frame in enumerate(content["frames"]):
            frame["file_path"] = listed.replace("N", str(number))
            frame.update({key: text.replace("N", str(number)) for key, text in more.items()})
        (folder / "transforms.json").write_text(json.dumps(content))
        return folder

    return made


def test_files_are_found(spoon, caplog):
    for number, line in enumerate(FOUND.strip().splitlines()):
        listed, file, told = line.split(":")
        scene = read(spoon(str(number), listed, file.strip()))
        assert [scene.frame_name(i) for i in range(3)] == [
            file.strip().replace("N", str(i)) for i in range(3)
        ]
        assert told.strip() in caplog.text
        assert bool(told.strip()) == bool(caplog.records), line
        caplog.clear()


def test_what_may_be_meant_by_two_names_or_none_is_refused(spoon):
    for number, line in enumerate(REFUSED.strip().splitlines()):
        told, listed, files = line.split(": ")
        folder = spoon(str(number), listed, *files.split())
        with pytest.raises((FileNotFoundError, ValueError), match=told):
            read(folder)


def test_masks_are_found_and_are_no_photos(spoon):
    names = ("images/N.jpg", "images/N.jpg", "masks/N.png")
    scene = read(spoon("a", *names, mask_path="C:/b/Masks/N.jpg"))
    assert [photo.mask.parent.name for photo in scene.photos] == ["masks"] * 3
    with pytest.raises(FileNotFoundError, match="masks"):
        read(spoon("b", *names[:2], mask_path="N.png"))
