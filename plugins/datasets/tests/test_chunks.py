import json
import math
import os
import pickle  # noqa: TID251  as multiprocessing does
import zipfile
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
import photo_formats
import pytest
import torch
from PIL import Image
from qgs_datasets.chunk_files import camera_problems, load_chunk, parse_record, stays_inside
from qgs_datasets.chunks import ChunksSource
from tables import fault
from upath import UPath


def encoded(color, size=(64, 36)):
    image = Image.new("RGB" if len(color) == 3 else "RGBA", size, color)
    return as_tensor(photo_formats.encoded(image))


def as_tensor(data):
    return torch.tensor(list(data), dtype=torch.uint8)


def camera(x=0.0):
    """A camera at (x, 2, 3) that is turned a quarter about z."""
    w2c = np.array([[0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0]], float)
    w2c[:, 3] = -w2c[:, :3] @ [x, 2, 3]
    return [0.5, 0.9, 0.45, 0.55, 0, 0, *w2c.flatten()]


def record(key, frames=4, **extra):
    return {
        "key": key,
        "url": "",
        "timestamps": torch.arange(frames) * 1000,
        "cameras": torch.tensor([camera(i) for i in range(frames)]),
        "images": [encoded((10 * i, 50, 200)) for i in range(frames)],
        **extra,
    }


def write(folder, chunks, index=True):
    folder.mkdir(parents=True, exist_ok=True)
    for name, records in chunks.items():
        with (folder / name).open("wb") as file:
            torch.save(records, file)
    if index:
        keys = {entry["key"]: name for name, records in chunks.items() for entry in records}
        (folder / "index.json").write_text(json.dumps(keys))


def data_set(path):
    write(path / "train", {"a.torch": [record("s0"), record("s1", 7)], "b.torch": [record("s2")]})
    write(path / "test", {"a.torch": [record("t0")]})


opened = partial(photo_formats.opened, size=(16, 16), source=ChunksSource)


def test_frames_and_cameras(tmp_path):
    data_set(tmp_path)
    source = opened(tmp_path)
    assert [scene.name for scene in source.scenes("train")] == ["s0", "s1", "s2"]
    assert [scene.name for scene in source.scenes("test")] == ["t0"]
    assert list(map(list, source.groups("train"))) == [[0, 1], [2]]
    scene = source.scenes("train")[1]
    assert len(scene) == 7
    c2w = scene.cameras.c2w[5]
    assert c2w.dtype == torch.float64
    assert c2w[:3, 3].tolist() == pytest.approx([5, 2, 3])
    assert c2w[:3, 0].tolist() == [0, 1, 0]  # the camera's x axis
    # 64 x 36 cropped to 36 x 36, 14 pixels off the left, then scaled by 16 / 36
    wanted = np.array([0.5 * 64, 0.9 * 36, 0.45 * 64 - 14, 0.55 * 36]) * 16 / 36
    assert scene.cameras.intrinsics[0].tolist() == pytest.approx(wanted.tolist(), rel=1e-6)
    images = scene.images([6, 2])
    assert images.shape == (2, 3, 16, 16)
    assert images[:, :, 5, 5].mul(255).round().tolist() == [[60, 50, 200], [20, 50, 200]]
    assert scene.frame_name(3) == "3000"
    assert scene.masks([0]) is None


def test_listing_opens_no_chunk(tmp_path):
    data_set(tmp_path)
    (tmp_path / "train" / "b.torch").write_bytes(b"nothing")
    source = opened(tmp_path)
    assert len(source.scenes("train")) == 3
    with pytest.raises(ValueError, match=r"b\.torch cannot be read as a torch file"):
        source.scenes("train")[2].cameras  # noqa: B018


def test_held_out_frames_serve_where_there_are_no_test_chunks(tmp_path):
    write(tmp_path / "train", {"a.torch": [record("s0")]})
    assert len(opened(tmp_path).scenes("test")) == 0
    source = opened(tmp_path, holdout=3)
    assert source.scenes("test")[0].held_out == (1,)
    write(tmp_path / "test", {"a.torch": [record("t0")]})
    assert opened(tmp_path, holdout=3).scenes("test")[0].name == "t0"


def test_chunks_without_split_folders_and_first_scenes(tmp_path):
    write(tmp_path, {"a.torch": [record("s0"), record("s1")]})
    assert len(opened(tmp_path).scenes("train")) == 2
    assert [scene.name for scene in opened(tmp_path, max_scenes=1).scenes("train")] == ["s0"]


def test_without_an_index_the_chunks_are_read(tmp_path, caplog):
    write(tmp_path / "train", {"a.torch": [record("s0")], "b.torch": [record("s1")]}, index=False)
    assert [scene.name for scene in opened(tmp_path).scenes("train")] == ["s0", "s1"]
    assert "has no index.json" in caplog.text
    write(tmp_path / "train", {"c.torch": [record("s1")]}, index=False)
    with pytest.raises(ValueError, match=r"'s1' is in b\.torch and in c\.torch"):
        opened(tmp_path)


def test_missing_chunks_and_short_scenes_are_counted_and_named(tmp_path, caplog):
    data_set(tmp_path)
    (tmp_path / "train" / "b.torch").unlink()
    source = opened(tmp_path, min_frames=5)
    assert "1 of 3 scenes" in caplog.text
    assert "s2 (b.torch)" in caplog.text
    assert [scene.name for scene in source.scenes("train")] == ["s1"]
    assert "fewer than 5 frames (min_frames) and are left out: s0 (4)" in caplog.text
    (tmp_path / "train" / "a.torch").unlink()
    with pytest.raises(FileNotFoundError, match="none of their chunks exists"):
        opened(tmp_path)


def test_urls(tmp_path):
    for url in (f"memory://chunks-{tmp_path}", f"file://{tmp_path}"):
        data_set(UPath(url))
        source = opened(url)
        assert list(map(list, source.groups("train"))) == [[0, 1], [2]]
        assert source.scenes("train")[1].images([3])[0, 0, 0, 0] * 255 == pytest.approx(30)


def test_legacy_files_are_read_whole(tmp_path):
    data_set(tmp_path)
    torch.save([record("s2")], tmp_path / "train" / "b.torch", _use_new_zipfile_serialization=False)
    assert not zipfile.is_zipfile(tmp_path / "train" / "b.torch")
    assert opened(tmp_path).scenes("train")[2].images([2])[0, 0, 0, 0] * 255 == pytest.approx(20)


def test_scenes_travel_to_other_processes_without_open_files(tmp_path):
    data_set(tmp_path)
    source = opened(tmp_path)
    scene = source.scenes("train")[0]
    before = scene.images([1])
    data = pickle.dumps(scene)
    assert len(data) < 2000
    copy = pickle.loads(data)  # noqa: S301
    assert torch.equal(copy.images([1]), before)
    assert len(pickle.loads(pickle.dumps(source)).scenes("train")) == 3  # noqa: S301


def test_threads_share_few_open_chunks(tmp_path):
    chunks = {f"{i}.torch": [record(f"s{i}", 2)] for i in range(8)}
    write(tmp_path / "train", chunks)
    scenes = opened(tmp_path).scenes("train")
    with ThreadPoolExecutor(4) as pool:
        images = list(pool.map(lambda k: scenes[k % 8].images([1])[0, 0, 0, 0] * 255, range(64)))
    assert images == pytest.approx([10] * 64)
    assert len(scenes[0]._chunks._kept) == 4


def test_masks_names_and_sizes_of_the_writer(tmp_path):
    mask = np.repeat([[0], [255]], [18, 18], 0).repeat(64, 1).astype(np.uint8)
    masks = [as_tensor(photo_formats.encoded(mask)), torch.empty(0).byte()]
    images = [encoded((0, 0, 0)), encoded((0, 0, 0), size=(36, 36))]
    sizes = torch.tensor([[36, 64], [36, 36]])
    names = ["a/0.jpg", "b.jpg"]
    extra = {"masks": masks, "sizes": sizes, "names": names, "images": images}
    write(tmp_path, {"a.torch": [record("s0", 2, **extra)]})
    scene = opened(tmp_path).scenes("train")[0]
    delivered = scene.masks([0, 1])
    assert delivered.shape == (2, 1, 16, 16)
    assert delivered[0, 0, [0, 15], 3].tolist() == [0, 1]
    assert delivered[1].min() == 1
    assert scene.frame_name(0) == "a/0.jpg"
    assert scene.cameras.intrinsics[1].tolist() == pytest.approx([8, 14.4, 7.2, 8.8])


def test_transparent_pixels_show_the_background(tmp_path):
    write(tmp_path, {"a.torch": [record("s0", 1, images=[encoded((9, 9, 9, 0))])]})
    scene = opened(tmp_path, background=(0.2, 0.4, 0.6)).scenes("train")[0]
    assert scene.images([0])[0, :, 0, 0].tolist() == pytest.approx([0.2, 0.4, 0.6])


BROKEN = {
    "no list": ({"key": "s0"}, "dict"),
    "no mappings": ([1], "'key'"),
    "too many cameras": ([record("s0", cameras=torch.zeros(5, 18))], "'s0': 'cameras'"),
    "a time for each": ([record("s0", times=torch.zeros(3))], "'s0': 'times'"),
    "times": ([record("s0", times=torch.tensor([0, 1, 2, math.nan]))], "'s0': 'times'"),
    "no images": ([record("s0", images=None)], "'s0': 'images'"),
    "no frames": ([record("s0", 0)], "'s0'"),
    "another key": ([record("s9")], "'s0'"),
    "one key twice": ([record("s0"), record("s0")], "'s0' twice"),
}


def length(path):
    return len(opened(path).scenes("train")[0])


def cameras(path):
    return opened(path).scenes("train")[0].cameras


def test_broken_chunks_are_told(tmp_path):
    (tmp_path / "index.json").write_text('{"s0": "a.torch"}')
    faults = {}
    for name, (records, message) in BROKEN.items():
        write(tmp_path, {"a.torch": records}, index=False)
        faults[name] = fault(rf"a\.torch.*{message}", length, tmp_path)
    assert not any(faults.values()), faults


def changed(row, column, value):
    cameras = record("s0")["cameras"]
    cameras[row, column] = value
    return cameras


UNMEANT = [
    ({"cameras": changed(2, 9, torch.nan)}, r"frame 2 \(2000\).*NaN"),
    ({"cameras": changed(1, 7, 3.0)}, "frame 1 .*not rigid"),
    ({"cameras": changed(1, 7, -1.0)}, "frame 1 .*mirrors"),
    ({"cameras": changed(3, 0, 500.0)}, "frame 3 .*pixels"),
    ({"cameras": changed(3, 1, -1.0)}, "frame 3 .*focal"),
    ({"images": [torch.zeros(9).byte()] * 4}, "frame 0 "),
    ({"images": [*record("s0", 3)["images"], encoded((1, 2, 3), (64, 64))]}, "frame 3 .*64 x"),
    ({"images": [*record("s0", 3)["images"], encoded((1, 2, 3))[:60]]}, "frame 3 "),
]


def all_images(path):
    scene = opened(path).scenes("train")[0]
    return scene.images(range(len(scene.cameras.c2w)))


def test_what_cannot_be_meant_names_file_key_and_frame(tmp_path):
    faults = []
    for extra, message in UNMEANT:
        write(tmp_path, {"a.torch": [record("s0", **extra)]})
        faults.append(fault(rf"a\.torch: scene 's0', {message}", all_images, tmp_path))
    assert not any(faults), faults


def test_broken_scenes_can_be_listed():
    faulty = parse_record("a.torch", record("s0", cameras=changed(2, 9, torch.nan)))
    assert len(faulty) == 4
    assert list(camera_problems(faulty, 1)) == []
    assert "NaN" in str(next(camera_problems(faulty, 2)))


HUGE = torch.zeros(1, dtype=torch.uint8).expand(10**12)


def test_a_small_file_does_not_fill_the_memory(tmp_path):
    for name, value in (
        ("images", [HUGE]),
        ("masks", [HUGE] * 4),
        ("timestamps", HUGE),
        ("held_out", HUGE),
        ("cameras", torch.zeros(1).expand(4, 18)),
        ("cameras", torch.zeros(4, 18).to_sparse()),
        ("cameras", torch.zeros(4, 18, device="meta")),
    ):
        write(tmp_path, {"a.torch": [record("s0", **{name: value})]})
        assert (tmp_path / "a.torch").stat().st_size < 20_000
        reason = rf"\A.*a\.torch: scene 's0': '{name}' holds a tensor.*\Z"
        assert not fault(reason, cameras, tmp_path)


def test_an_index_does_not_lead_outside(tmp_path):
    data_set(tmp_path)
    for name in ("../test/a.torch", str(tmp_path / "test" / "a.torch"), "c:\\a.torch"):
        (tmp_path / "train" / "index.json").write_text(json.dumps({"s0": name}))
        with pytest.raises(ValueError, match="outside its own folder"):
            opened(tmp_path)
    (tmp_path / "train" / "index.json").write_text("[1]")
    with pytest.raises(ValueError, match="must map each scene's key"):
        opened(tmp_path)


def test_names_that_stay_inside():
    inside = ["a", "a/b.torch", "a..b", ".hidden", "a\\b"]
    outside = ["..", "a/../b", "/a", "\\a", "a\\..\\..\\b", "c:/a", "", "C:a"]
    assert [name for name in inside + outside if stays_inside(name)] == inside


def test_folders_that_are_not_there(tmp_path):
    with pytest.raises(FileNotFoundError, match="does not exist"):
        opened(tmp_path / "nothing")
    with pytest.raises(FileNotFoundError, match=r"holds no chunks.*qgs data pack"):
        opened(tmp_path)
    with pytest.raises(ValueError, match="cannot be opened as a path or URL"):
        opened("nosuch://bucket")


def test_code_in_a_chunk_is_not_run(tmp_path):
    class Payload:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "made"),)

    torch.save([Payload()], tmp_path / "a.torch")
    with pytest.raises(ValueError, match="cannot be read as a torch file"):
        load_chunk(UPath(tmp_path / "a.torch"))
    assert not (tmp_path / "made").exists()


def test_a_chunk_that_cannot_be_read_is_named_without_torchs_advice(tmp_path):
    file = tmp_path / "0.torch"
    torch.save([UPath(tmp_path)], file)
    for content in (file.read_bytes(), file.read_bytes()[:300], b""):
        file.write_bytes(content)
        with pytest.raises(ValueError, match=r"0\.torch") as error:
            load_chunk(UPath(file))
        assert "trust" not in str(error.value)
    with pytest.raises(FileNotFoundError, match=r"1\.torch"):
        load_chunk(UPath(tmp_path / "1.torch"))
