"""Photos that lie elsewhere, or are called otherwise, than their listing says."""

import pytest
from photo_formats import encoded, put, row_of_frames
from photo_formats import scene as read
from PIL import Image
from tables import must_not_find, must_refuse, rows, write_json

FOUND = """
images/N.png: images/N.png:
./train/N: train/N.png:
train/at_0.N: train/at_0.N.png:
images/N.JPG: images/N.JPG:
images\\N.jp2: images/N.jp2:
images/N.exr: images/N.exr:
C\\Users\\me\\spoon\\images\\N.png: images/N.png: told
/data/me/spoon/images/N.png: images/N.png: told
/data/N.png: N.png: told
../spoon/images/N.png: images/N.png: told
images/N.png: N.png: told
N.png: images/N.png: told
images/images/N.png: images/N.png: told
images/cam\\N.png: cam/N.png: told
images/N.png: images_4/N.png:
images/N.png: Images/N.png: told
images/N.jpg: images/N.JPG: told
Images/viewN.png: images/VIEWN.png: told
images/zoe\u0301N.png: images/zo\u00e9N.png: told
images/N: images/N.jpg: told
images/N.jpeg: images/N.png: told
images/N.0: images/N.0.webp: told
D\\a\\N.webp: Images/N.jpg: told
"""
"""As listed, as the file is called, and whether a note tells it."""
REFUSED = """
names 3 images, but 0 exist: images/N.png: masks/N.png
fits two names: N/0.png: images/0.png
names 3 images, but 0 exist: /data/N.png: masks/N.png
may be any of: images/N.jpg: images/N.JPG images/N.Jpg
may be any of: images/N.webp: images/N.jpg images/N.png
"""
"""What is told, as listed, and as files are called."""


@pytest.fixture
def spoon(tmp_path):
    """Three photos of the names `files`, which are listed as `listed`."""

    def made(name, listed, *files, **more):
        folder = tmp_path / name
        for number in "012":
            for file in files:
                put(folder / file.replace("N", number), encoded(Image.new("RGB", (40, 30))))
        content = row_of_frames(3, fl_x=40, w=40, h=30)
        for number, frame in enumerate(content["frames"]):
            named = {"file_path": listed, **more}
            frame |= {key: text.replace("N", str(number)) for key, text in named.items()}
        write_json(folder / "transforms.json", content)
        return folder

    return made


def test_files_are_found(spoon, caplog):
    for number, (listed, file, told) in enumerate(rows(FOUND, ":")):
        scene = read(spoon(str(number), listed, file.strip()))
        for i in range(3):
            assert scene.frame_name(i) == file.strip().replace("N", str(i))
        notes = [record.message for record in caplog.records]
        assert len(notes) == bool(told.strip()), listed
        assert all("3 of 3 files" in note and str(scene.photos[0].path) in note for note in notes)
        caplog.clear()


def test_what_may_be_meant_by_two_names_or_none_is_refused(spoon):
    for number, (told, listed, files) in enumerate(rows(REFUSED, ": ")):
        folder = spoon(str(number), listed, *files.split())
        must_refuse(told, read, folder, kind=(FileNotFoundError, ValueError))


def test_masks_are_found_and_are_no_photos(spoon):
    names = ("images/N.jpg", "images/N.jpg", "masks/N.png")
    scene = read(spoon("a", *names, mask_path="C:/b/Masks/N.jpg"))
    assert [photo.mask.parent.name for photo in scene.photos] == ["masks"] * 3
    must_not_find("masks", read, spoon("b", *names[:2], mask_path="N.png"))
