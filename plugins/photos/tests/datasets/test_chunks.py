import zipfile
from functools import partial
from pathlib import Path

import numpy as np
import photo_formats
import pytest
import torch
from PIL import Image
from planted import as_tensor, entry, save
from qgs_photos.datasets.chunk_files import load_chunk
from qgs_photos.datasets.chunks import ChunksSource
from small_parts import Code
from tables import assert_equal, assert_near, must_not_find, must_refuse, write_json
from upath import UPath

INDEX = Path("train/index.json")
pytestmark = pytest.mark.usefixtures("here")


def encoded(color, size=(64, 36)):
    mode = "RGB" if len(color) == 3 else "RGBA"
    return as_tensor(photo_formats.encoded(Image.new(mode, size, color)))


def pose(x):
    """A camera at (x, 2, 3); its x axis is the world's z."""
    c2w = np.eye(4)[[1, 2, 0, 3]]
    c2w[:3, 3] = x, 2, 3
    return c2w


def record(key, frames=4, **extra):
    images = [encoded((10 * i, 50, 200)) for i in range(frames)]
    return entry(key, (0.5, 0.9, 0.45, 0.55), map(pose, range(frames)), images) | extra


def write(folder=".", **chunks):
    """Chunks, by their names without the suffix."""
    for name, records in chunks.items():
        save(Path(folder, f"{name}.torch"), records)


@pytest.fixture
def data_set(here):
    """With an index of the scenes for training."""
    write("train", a=[record("s0"), record("s1", 7)], b=[record("s2")])
    write("test", a=[record("t0")])
    write_json(INDEX, {"s0": "a.torch", "s1": "a.torch", "s2": "b.torch"})


opened = partial(photo_formats.opened, path=".", size=(16, 16), source=ChunksSource)
first = partial(photo_formats.scene, path=".", size=(16, 16), source=ChunksSource)


def test_frames_and_cameras(data_set):
    source = opened()
    assert source.names("train") == ["s0", "s1", "s2"]
    assert source.names("test") == ["t0"]
    scene = source.scenes("train")[1]
    assert len(scene) == 7
    c2w = scene.cameras.c2w[5]
    assert c2w.dtype == torch.float64
    assert_near(c2w[:3, 3], [5, 2, 3])
    assert c2w[:3, 0].tolist() == [0, 0, 1]  # the camera's x axis
    # 64 x 36 cropped to 36 x 36, 14 pixels off the left, then scaled by 16 / 36
    wanted = np.array([0.5 * 64, 0.9 * 36, 0.45 * 64 - 14, 0.55 * 36]) * 16 / 36
    assert_near(scene.cameras.intrinsics[0], wanted)
    pixels = scene.images([6, 2])[:, :, 5, 5].mul(255).round()
    assert pixels.tolist() == [[60, 50, 200], [20, 50, 200]]
    assert scene.frame_name(3) == "3000"
    assert scene.masks([0]) is None


def test_listing_opens_no_chunk(data_set):
    Path("train/b.torch").write_bytes(b"nothing")
    source = opened()
    assert len(source.scenes("train")) == 3
    scene = source.scenes("train")[2]
    must_refuse(r"b\.torch cannot be read as a torch file", getattr, scene, "cameras")


def test_held_out_frames_serve_where_there_are_no_test_chunks():
    write("train", a=[record("s0")])
    assert opened().names("test") == []
    assert opened(holdout=3).scenes("test")[0].held_out == (1,)
    write("test", a=[record("t0")])
    assert opened(holdout=3).names("test") == ["t0"]


def test_without_an_index_and_split_folders_the_chunks_are_read(caplog):
    write(a=[record("s0")], b=[record("s1")])
    assert opened().names("train") == ["s0", "s1"]
    assert opened(max_scenes=1).names("train") == ["s0"]
    assert "has no index.json" in caplog.text
    write(c=[record("s1")])
    must_refuse(r"'s1' is in b\.torch and in c\.torch", opened)


def test_missing_chunks_and_short_scenes_are_counted_and_named(data_set, caplog):
    Path("train/b.torch").unlink()
    source = opened(min_frames=5)
    assert "1 of 3 scenes" in caplog.text
    assert "s2 (b.torch)" in caplog.text
    assert source.names("train") == ["s1"]
    assert "fewer than 5 frames (min_frames) and are left out: s0 (4)" in caplog.text
    Path("train/a.torch").unlink()
    must_not_find("none of their chunks exists", opened)


def test_legacy_files_are_read_whole(data_set):
    torch.save([record("s2")], "train/b.torch", _use_new_zipfile_serialization=False)
    assert not zipfile.is_zipfile("train/b.torch")
    assert_near(opened().scenes("train")[2].images([2])[0, 0, 0, 0] * 255, 20)


def test_scenes_travel_to_other_processes_without_open_files(data_set):
    photo_formats.assert_travels(opened())


def test_masks_names_sizes_and_backgrounds():
    mask = np.repeat([[0], [255]], [18, 18], 0).repeat(64, 1).astype(np.uint8)
    extra = {
        "masks": [as_tensor(photo_formats.encoded(mask)), torch.empty(0).byte()],
        "images": [encoded((9, 9, 9, 0)), encoded((0, 0, 0), (36, 36))],
        "sizes": torch.tensor([[36, 64], [36, 36]]),
        "names": ["a/0.jpg", "b.jpg"],
    }
    write(a=[record("s0", 2, **extra)])
    scene = first(background=(0.2, 0.4, 0.6))
    masks = scene.masks([0, 1])
    assert masks[0, 0, [0, 15], 3].tolist() == [0, 1]
    assert_equal(masks[1], torch.ones(1, 16, 16))
    assert scene.frame_name(0) == "a/0.jpg"
    assert_near(scene.cameras.intrinsics[1], [8, 14.4, 7.2, 8.8])
    assert_near(scene.images([0])[0, :, 0, 0], [0.2, 0.4, 0.6])


def changed(row, column, value):
    """Cameras of a record with another number."""
    cameras = record("s0")["cameras"]
    cameras[row, column] = value
    return cameras


PHOTOS = record("s0", 3)["images"]
BROKEN = (
    ({"cameras": torch.zeros(5, 18)}, ": 'cameras'"),
    ({"times": torch.zeros(3)}, ": 'times'"),
    ({"times": torch.tensor([0, 1, 2, torch.nan])}, ": 'times'"),
    ({"images": None}, ": 'images'"),
    ({"frames": 0}, ""),
    ({"cameras": changed(2, 9, torch.nan)}, r", frame 2 \(2000\).*NaN"),
    ({"cameras": changed(3, 0, 500.0)}, ", frame 3 .*pixels"),
    ({"cameras": changed(3, 1, -1.0)}, ", frame 3 .*focal"),
    ({"images": [torch.zeros(9).byte()] * 4}, ", frame 0 "),
    ({"images": [*PHOTOS, encoded((1, 2, 3), (64, 64))]}, ", frame 3 .*64 x"),
    ({"images": [*PHOTOS, encoded((1, 2, 3))[:60]]}, ", frame 3 "),
)
"""What is wrong with a scene, and what is told behind its name.

tests/data/test_photos.py has the other poses that the same function refuses.
"""


def all_images():
    scene = first()
    return scene.images(range(len(scene.cameras.c2w)))


def test_broken_chunks_are_told():
    Path("index.json").write_text('{"s0": "a.torch"}')
    cases = [
        ({"key": "s0"}, "dict"),
        ([1], "'key'"),
        ([record("s9")], "'s0'"),
        ([record("s0"), record("s0")], "'s0' twice"),
    ]
    cases += [([record("s0", **extra)], f"scene 's0'{told}") for extra, told in BROKEN]
    for records, message in cases:
        write(a=records)
        must_refuse(rf"a\.torch.*{message}", all_images)


HUGE = torch.zeros(1).byte().expand(10**12)


def test_a_small_file_does_not_fill_the_memory():
    for name, value in (
        ("images", [HUGE]),
        ("masks", [HUGE] * 4),
        ("timestamps", HUGE),
        ("held_out", HUGE),
        ("cameras", torch.zeros(1).expand(4, 18)),
        ("cameras", torch.zeros(4, 18).to_sparse()),
        ("cameras", torch.zeros(4, 18, device="meta")),
    ):
        write(a=[record("s0", **{name: value})])
        assert Path("a.torch").stat().st_size < 20_000
        must_refuse(rf"\A.*a\.torch: scene 's0': '{name}' holds a tensor.*\Z", all_images)


def test_an_index_does_not_lead_outside(data_set):
    outside = ("../test/a.torch", f"{Path.cwd()}/test/a.torch", "c:\\a.torch", "a/../../b", "")
    for name in (*outside, "\\a", "a\\..\\..\\b", "C:a"):
        write_json(INDEX, {"s0": name})
        must_refuse("outside the folder", opened)
    INDEX.write_text("[1]")
    must_refuse("must map each scene's key", opened)


def test_folders_that_are_not_there():
    empty = "holds no chunks.*qgs data pack"
    must_not_find("does not exist", opened, path="nothing")
    must_not_find(empty, opened)
    must_refuse("cannot be opened as a path or URL", opened, path="nosuch://bucket")


def test_code_in_a_chunk_is_not_run_nor_advised():
    file = Path("0.torch")
    torch.save([Code()], file)
    for content in (file.read_bytes(), file.read_bytes()[:300], b""):
        file.write_bytes(content)
        reason = r"0\.torch cannot be read as a torch file"
        assert "trust" not in str(must_refuse(reason, load_chunk, UPath(file)))
    must_not_find(r"1\.torch", load_chunk, UPath("1.torch"))
