import json
import zipfile
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import photo_formats
import pytest
from photo_formats import assert_travels, listed_lens, opengl, put, row_of_frames
from PIL import Image
from qgs_photos.datasets.dl3dv import Dl3dvSource, read_scene_list
from tables import assert_near, must_not_find, must_refuse, rows
from upath import UPath
from walk import along_x

pytestmark = pytest.mark.usefixtures("here")


def photo(number, size=(32, 18)):
    """A PNG whose red channel is 10 times its number."""
    return photo_formats.encoded(Image.new("RGB", size, (10 * number, 50, 200)))


LENS = listed_lens(100.0, 101.0, 60.0, 37.0, 72, 128)
LISTING = json.dumps(row_of_frames(4, **LENS)).encode()


def scene_files(inside="", images="images_4"):
    files = {f"{inside}{images}/{i}.png": photo(i) for i in range(4)}
    return {f"{inside}transforms.json": LISTING, **files}


def write(path, files):
    """An archive or a folder, by the suffix of `path`."""
    path = UPath(path)
    if path.suffix != ".zip":
        for name, data in files.items():
            put(path / name, data)
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file, zipfile.ZipFile(file, "w") as zipped:
        for name, data in files.items():
            zipped.writestr(name, data)


opened = partial(photo_formats.opened, path=".", size=(9, 16), source=Dl3dvSource)
scene = partial(photo_formats.scene, path=".", size=(9, 16), source=Dl3dvSource)


PLACES = """
1K/abc.zip | abc/ | images_4
abc.zip |  | images_4
2K/abc |  | images_4
abc | gaussian_splat/ | images_4
abc.zip | abc/gaussian_splat/ | images_4
abc |  | images
"""
"""Archives and folders, folders inside them, and those of photos."""


def test_folders_and_archives_read_alike(tmp_path):
    for number, (name, inside, images) in enumerate(rows(PLACES)):
        local = tmp_path / str(number)
        for root in (UPath(local), UPath(f"memory://dl3dv{local}")):
            write(root / name, scene_files(inside, images))
            is_read_as_written(root)
        is_read_as_written(f"file://{local}")


def is_read_as_written(root):
    (scene,) = opened(path=root).scenes("train")
    assert scene.name == "abc"
    assert len(scene) == 4
    assert scene.cameras.c2w[2].tolist() == opengl(along_x([2.0]).numpy()[0])
    # an eighth of the listed 128 x 72, whatever the size of the photos
    assert_near(scene.cameras.intrinsics[0], [12.5, 12.625, 7.5, 4.625])
    assert scene.images([3, 1])[:, 0, 4, 4].mul(255).round().tolist() == [30, 10]


def test_reduced_photos_are_chosen():
    files = scene_files(images="images_8") | scene_files()
    write("abc", {**files, "images_8/0.png": photo(9, (16, 9))})
    for options, red in (({"images": "images_8"}, 90), ({}, 0)):
        assert_near(scene(**options).images([0])[0, 0, 0, 0] * 255, red)
    must_not_find("images_2", scene, images="images_2")


def length():
    return len(scene().cameras.c2w)


def test_incomplete_and_broken_archives_are_told():
    for files, file in (
        ({"abc/images_4/0.png": b""}, r"abc\.zip"),
        ({"abc/transforms.json": b"{"}, r"abc/transforms\.json::.*abc\.zip"),
        ({"abc/transforms.json": LISTING}, "`images`"),
    ):
        write("abc.zip", files)
        must_refuse(file, length, kind=(ValueError, OSError))
    Path("abc.zip").write_bytes(b"PK nothing")
    opened()  # listed without being opened
    must_refuse(r"abc\.zip", length)


def test_a_damaged_photo_names_archive_and_file():
    archive = Path("abc.zip")
    write(archive, scene_files("abc/"))
    data = bytearray(archive.read_bytes())
    data[data.index(photo(1)) + 60] ^= 255
    archive.write_bytes(data)
    must_refuse(r"abc/images_4/1\.png::.*abc\.zip", scene().images, [1])


def several():
    for i in range(4):
        write(f"1K/s{i}.zip", scene_files(f"s{i}/"))


def test_test_scenes(caplog):
    several()
    assert opened().names("train") == ["s0", "s1", "s2", "s3"]
    assert opened().names("test") == []
    Path("index.json").write_text('{"s2": null, "gone": null, "s0": null}')
    source = opened(test_scenes="index.json")
    assert source.names("train") == ["s1", "s3"]
    assert source.names("test") == ["s2", "s0"]
    assert "1 of 3 test scenes" in caplog.text
    held_out = opened(holdout=3, max_scenes=2).scenes("test")
    assert [scene.held_out for scene in held_out] == [(1,), (1,)]


def test_lists_of_scenes():
    text = UPath("list.txt")
    listed = UPath("list.json")
    text.write_text("# benchmark\ns1\n\ns2  # hard\ns1\n")
    listed.write_text('["s3"]')
    assert read_scene_list(text) == ["s1", "s2"]
    assert read_scene_list(listed) == ["s3"]
    text.write_text("# none\n")
    listed.write_text("3")
    for wrong in (text, listed):
        must_refuse(wrong.name, read_scene_list, wrong)
    gone = text.with_name("gone.txt")
    must_not_find(gone.name, read_scene_list, gone)


def test_a_scene_that_is_there_twice_is_told(caplog):
    several()
    write("1K/s0", scene_files())
    assert len(opened().scenes("train")) == 4
    assert "1 scenes of" in caplog.text


def test_folders_that_are_not_there():
    must_not_find("nothing", opened, path="nothing")
    Path("a.txt").touch()
    must_not_find(r"a\.txt", opened)


def test_other_processes_and_threads_read_one_archive():
    several()
    source = opened()
    assert_travels(source)
    scenes = source.scenes("train")
    with ThreadPoolExecutor(4) as threads:
        red = list(threads.map(lambda k: scenes[k % 4].images([k % 3])[0, 0, 0, 0], range(24)))
    assert_near(red, [10 * (k % 3) / 255 for k in range(24)])
