"""What is odd but may be meant, what is not done, and what is told of it."""

import shutil

import pytest
from PIL import Image
from planted import FLIP, FRAMES, HASH, told
from qgs_datatools.check import Options, check
from textured_room import SIZE
from upath import UPath

SIDES = ("w", "h", "fl_x", "fl_y", "cx", "cy")


def test_a_scaled_copy_passes(room):
    room.listing(lambda data: data.update({key: 4 * data[key] for key in SIDES}))
    (room.path / "images").rename(room.path / "images_4")
    assert told(room.path) == []


def test_a_repeated_photo_is_a_warning(room, shots):
    room.poses(lambda number, pose: shots[2].c2w @ FLIP if number == 5 else pose)
    shutil.copy(room.path / "images" / "2.jpg", room.path / "images" / "5.jpg")
    assert told(room.path) == [
        "warning: room, frame 5 (images/5.jpg): the photo and its pose repeat frame 2 "
        "(images/2.jpg): remove one of the two"
    ]


def with_times(*times):
    def change(data):
        for frame, time in zip(data["frames"], times, strict=False):
            frame["time"] = time

    return change


def test_a_camera_that_stands_still_may_film_what_moves(room, shots):
    room.poses(lambda number, pose: shots[2].c2w @ FLIP if number == 5 else pose)
    assert len(told(room.path, geometry=0)) == 1
    room.listing(with_times(*range(FRAMES)))
    assert told(room.path, geometry=0) == []
    room.listing(with_times(*[0.5] * FRAMES))
    assert len(told(room.path, geometry=0)) == 1


def test_times_that_are_wrong_or_missing(room):
    room.listing(with_times(0, 1, "2", 3))
    assert told(room.path, geometry=0) == [
        "error: room, frame 2 (images/2.jpg): 'time' must be a finite number, got '2': correct it",
        "error: room, frames 4-5 (images/4.jpg to images/5.jpg): it has no 'time', like 3 of 6 "
        "frames, and the others have: write it for each, or for none where nothing moves",
    ]


def test_chunk_that_index_json_names_and_that_is_missing(chunks):
    index = '{"a": "0.torch", "c": "1.torch", "d": "0.torch"}'
    (chunks.path / "test" / "index.json").write_text(index)
    assert told(chunks.path, geometry=0) == [
        "error: test/1.torch: the chunk does not exist; index.json places there 1 scene: c: "
        "download the chunk, or take its scenes out of index.json",
        "error: d: test/index.json places the scene in 0.torch, which does not hold it: take the "
        "scene out of index.json, or get the chunk that holds it",
        "warning: b: test/0.torch holds the scene, but test/index.json does not name it, so that "
        "it is never read: add it to index.json",
    ]


def test_plain_photos_are_not_judged_and_that_is_told(room):
    for number in range(FRAMES):
        shade = (20 * number, 30, 90)
        Image.new("RGB", SIZE[::-1], shade).save(room.path / "images" / f"{number}.jpg")
    assert told(room.path, geometry=1) == [
        "warning: room: the poses are not judged against the photos: too few matches, below 24 in "
        "every pair that was tried: look at the cameras yourself, in the picture that --report "
        "draws"
    ]


def test_masks_that_are_missing_or_damaged(room):
    (room.path / "masks").mkdir()
    (room.path / "masks" / "1.png").write_bytes(b"no image")
    Image.linear_gradient("L").resize(SIZE[::-1]).save(room.path / "masks" / "2.png")
    masks = enumerate(f"masks/{number}.png" for number in range(3))
    room.listing(lambda data: [data["frames"][i].update(mask_path=mask) for i, mask in masks])
    first, second = told(room.path, geometry=0)
    assert first == (
        "error: room, frame 0 (images/0.jpg): its mask does not exist in masks: add it, or list no "
        "mask"
    )
    assert second.startswith("error: room, frame 1 (images/1.jpg): ")
    assert "1.png cannot be read as the mask of a photo" in second


def test_other_data_sets_beside_scenes_are_named(room, chunks, tmp_path):
    assert told(tmp_path) == [
        "warning: chunks: the folder is another data set (chunks) and is not checked with the "
        f"photos beside it: run `qgs data check {chunks.path}`"
    ]


def test_single_files_are_data_sets_too(good):
    def names(path):
        return [scene.name for scene in check(UPath(path), Options(headers_only=True)).scenes]

    assert names(good / "archives" / f"{HASH}.zip") == [HASH]
    assert names(good / "chunks" / "test" / "0.torch") == ["a", "b"]
    assert names(good / "room" / "transforms.json") == ["room"]


def test_nothing_passes_in_silence(room, chunks):
    with pytest.raises(FileNotFoundError, match="holds no chunks: leave --format out"):
        check(UPath(room.path), Options(format="chunks"))
    with pytest.raises(FileNotFoundError, match="no evaluation index at"):
        check(UPath(room.path), Options(geometry=0), [UPath(room.path / "none.json")])
    chunks.chunk(lambda _: [])
    (line,) = [line for line in told(chunks.path) if "0.torch: " in line]
    assert line.startswith("error: test/0.torch: the chunk holds no scene: pack the data set again")
