import io
import json
import os
import signal
import time
from functools import partial

import numpy as np
import photo_formats
import pytest
import torch
from commands import run_qgs
from PIL import Image
from qgs_datasets.chunks import ChunksSource
from qgs_datatools import packing
from upath import UPath

from qgs.composer import resolve
from qgs.data.paths import opened_path

SIZE = (24, 32)
GIVEN = {"w": 64, "h": 48, "fl_x": 60.0, "fl_y": 61.0, "cx": 31.0, "cy": 25.0}


def noise(seed: int, size=(64, 48)) -> Image.Image:
    rng = np.random.default_rng(seed)
    return Image.fromarray(rng.integers(0, 256, (size[1], size[0], 3), dtype=np.uint8))


def photos(
    path, frames: int = 4, suffix=".png", convert=lambda image: image, mask=False, times=None, **top
):
    """A scene of noise in nerfstudio's format; returns its folder."""
    entries = []
    (path / "images").mkdir(parents=True, exist_ok=True)
    for i in range(frames):
        convert(noise(i)).save(path / "images" / f"{i}{suffix}")
        pose = np.eye(4)
        pose[:3, 3] = 0.3 * i, 5.1, -1000.7
        entry = {"file_path": f"images/{i}{suffix}", "transform_matrix": pose.tolist()}
        if mask and i % 2:
            noise(100 + i).convert("L").save(path / f"mask{i}.png")
            entry["mask_path"] = f"mask{i}.png"
        entries.append({**entry, "time": times[i]} if times else entry)
    (path / "transforms.json").write_text(json.dumps({**GIVEN, **top, "frames": entries}))
    return path


source = partial(photo_formats.opened, size=SIZE, holdout=3)
packed = partial(photo_formats.opened, size=SIZE, source=ChunksSource)


def pack(photos, out, encoding=None, **options) -> packing.Packed:
    return packing.pack(
        photos, packing.own_splits(photos), UPath(out), {"path": "photos"}, encoding, **options
    )


def same(one, other, tolerance: float = 0.0) -> None:
    frames = range(len(one))
    assert [one.frame_name(i) for i in frames] == [other.frame_name(i) for i in frames]
    assert list(one.held_out) == list(other.held_out)
    assert (one.times is None) == (other.times is None)
    assert one.times is None or torch.equal(one.times, other.times)
    assert (one.images(frames) - other.images(frames)).abs().max() <= tolerance
    expected, given = one.masks(frames), other.masks(frames)
    assert given is None if expected is None else torch.equal(expected, given)
    close = partial(torch.testing.assert_close, atol=1e-4, rtol=0, check_dtype=False)
    close(one.cameras.intrinsics, other.cameras.intrinsics)
    close(one.cameras.c2w, other.cameras.c2w)


CASES = {
    "png": ({}, 4),
    "jpeg": ({"suffix": ".jpg"}, 4),
    "mpo": ({"suffix": ".mpo"}, 4),
    "webp": ({"suffix": ".webp"}, 0),
    "grey": ({"convert": lambda image: image.convert("L")}, 0),
    "transparent": ({"convert": lambda image: with_alpha(image)}, 0),
    "masks": ({"mask": True}, 4),
    "times": ({"times": [0.1, 0.2, 0.2, 0.7]}, 4),
    "distorted": ({"k1": -0.2, "p1": 0.01, "camera_model": "OPENCV"}, 0),
    "distorted masks": ({"mask": True, "k1": -0.2, "camera_model": "OPENCV"}, 0),
}


def with_alpha(image: Image.Image) -> Image.Image:
    image.putalpha(image.getchannel("R"))
    return image


@pytest.mark.parametrize("case", CASES)
def test_chunks_read_as_their_source_does(tmp_path, case):
    options, kept = CASES[case]
    before = source(photos(tmp_path / "scene", **options), background=(0.2, 0.5, 0.9))
    result = pack(before, tmp_path / "chunks")
    assert (result.scenes, result.frames, result.kept) == ({"train": 1, "test": 0}, 4, kept)
    after = packed(tmp_path / "chunks")
    same(before.scenes("train")[0], after.scenes("train")[0])
    assert len(after.scenes("test")) == 1  # the same scene, for its held-out frames


def test_original_bytes_are_kept(tmp_path):
    before = source(photos(tmp_path / "scene", suffix=".jpg"))
    pack(before, tmp_path / "chunks")
    (entry,) = torch.load(tmp_path / "chunks" / "train" / "000000.torch", weights_only=True)
    file = tmp_path / "scene" / "images" / "2.jpg"
    assert entry["images"][2].numpy().tobytes() == file.read_bytes()
    assert entry["cameras"].dtype == torch.float32
    assert entry["cameras"][0, :4].tolist() == pytest.approx([60 / 64, 61 / 48, 31 / 64, 25 / 48])
    w2c = torch.eye(4)
    w2c[:3] = entry["cameras"][3, 6:].reshape(3, 4)
    assert torch.allclose(w2c @ before.scenes("train")[0].cameras.c2w[3].float(), torch.eye(4))
    assert {"key", "url", "timestamps", "cameras", "images"} <= set(entry)


def test_resized_and_as_jpeg(tmp_path):
    before = source(photos(tmp_path / "scene", mask=True, times=[3, 2, 1, 0]))
    pack(before, tmp_path / "png", packing.Encoding(resized=True))
    same(before.scenes("train")[0], packed(tmp_path / "png").scenes("train")[0])
    pack(before, tmp_path / "jpeg", packing.Encoding(resized=True, jpeg=90))
    same(before.scenes("train")[0], packed(tmp_path / "jpeg").scenes("train")[0], 0.5)
    (entry,) = torch.load(tmp_path / "jpeg" / "train" / "000000.torch", weights_only=True)
    with Image.open(io.BytesIO(entry["images"][0].numpy())) as image:
        assert (image.format, image.size) == ("JPEG", (32, 24))


@pytest.mark.parametrize("url", ["memory://packed{}", "file://{}"])
def test_to_urls_and_from_chunks_again(tmp_path, url):
    first, second = (UPath(url.format(tmp_path / name)) for name in ("one", "two"))
    before = source(photos(tmp_path / "scene", mask=True, times=[1.7e9, 1.7e9, 1.7e9 + 0.01, 0]))
    pack(before, first)
    pack(packed(first), second)
    same(packed(first).scenes("train")[0], packed(second).scenes("train")[0])
    same(before.scenes("train")[0], packed(second).scenes("train")[0])
    names = sorted(item.name for item in (second / "train").iterdir())
    assert names == ["000000.torch", "index.json"]


def many(path, count: int = 6):
    for i in range(count):
        photos(path / f"s{i}", frames=2)
    return path


def test_chunks_are_bounded_in_size_and_order_is_kept(tmp_path):
    before = source(many(tmp_path / "scenes"))
    one_scene = 2 * len((tmp_path / "scenes" / "s0" / "images" / "0.png").read_bytes())
    pack(before, tmp_path / "chunks", chunk_bytes=int(2.5 * one_scene))
    after = packed(tmp_path / "chunks")
    assert [scene.name for scene in after.scenes("train")] == [f"s{i}" for i in range(6)]
    assert list(map(list, after.groups("train"))) == [[0, 1], [2, 3], [4, 5]]
    files = sorted((tmp_path / "chunks" / "train").glob("*.torch"))
    assert all(file.stat().st_size < 2.5 * one_scene + 20_000 for file in files)


def test_splits(tmp_path):
    before = source(many(tmp_path / "scenes"))
    named = packing.splits_by_list(before, ["s4", "s1"])
    assert [list(places) for places in named.values()] == [["s0", "s2", "s3", "s5"], ["s1", "s4"]]
    numbered = packing.splits_by_number(before, 3)
    assert list(numbered["test"]) == ["s2", "s5"]
    assert list(numbered["train"]) == ["s0", "s1", "s3", "s4"]
    with pytest.raises(ValueError, match="1 of 2 test scenes are not there: gone"):
        packing.splits_by_list(before, ["s1", "gone"])
    packing.pack(before, numbered, UPath(tmp_path / "chunks"), {})
    after = packed(tmp_path / "chunks")
    assert [scene.name for scene in after.scenes("test")] == ["s2", "s5"]


def test_what_is_there_is_never_overwritten(tmp_path):
    before = source(photos(tmp_path / "scene"))
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "a.txt").write_text("mine")
    with pytest.raises(FileExistsError, match=r"not empty \(a\.txt\)"):
        pack(before, tmp_path / "notes")
    pack(before, tmp_path / "chunks")
    with pytest.raises(FileExistsError, match="never overwrites"):
        pack(before, tmp_path / "chunks")


def broken(path):
    image = path / "s3" / "images" / "1.png"
    image.write_bytes(image.read_bytes()[:200])
    return image


def test_an_interrupted_packing_goes_on(tmp_path):
    image = many(tmp_path / "scenes") / "s3" / "images" / "1.png"
    whole = image.read_bytes()
    broken(tmp_path / "scenes")
    out = tmp_path / "chunks"
    with pytest.raises(ValueError, match=r"scene 's3', frame 1 \(images/1\.png\) cannot be read"):
        pack(source(tmp_path / "scenes"), out, chunk_bytes=1)
    assert not list(out.rglob("index.json"))
    with pytest.raises(ValueError, match=r"other settings .*chunk_bytes was 1, is 2"):
        pack(source(tmp_path / "scenes"), out, chunk_bytes=2)
    (out / "train" / ".000003.torch.99.tmp").write_bytes(b"left by a killed process")
    first = (out / "train" / "000000.torch").stat().st_mtime_ns
    image.write_bytes(whole)
    before = source(tmp_path / "scenes")
    result = pack(before, out, chunk_bytes=1)
    assert (result.scenes["train"], result.resumed, result.frames) == (6, 2, 8)
    assert (out / "train" / "000000.torch").stat().st_mtime_ns == first
    assert sorted(item.name for item in out.iterdir()) == ["train"]
    assert not list((out / "train").glob(".*"))
    for one, other in zip(before.scenes("train"), packed(out).scenes("train"), strict=True):
        same(one, other)


def test_scenes_that_cannot_be_read_are_left_out_by_name(tmp_path):
    broken(many(tmp_path / "scenes"))
    before = source(tmp_path / "scenes")
    result = pack(before, tmp_path / "chunks", leave_out_broken=True)
    assert result.scenes["train"] == 5
    assert list(result.left_out) == ["s3"]
    assert "images/1.png" in result.left_out["s3"]
    broken_alone = {"train": {"s3": packing.own_splits(before)["train"]["s3"]}, "test": {}}
    with pytest.raises(ValueError, match="no scene to pack: s3: "):
        packing.pack(before, broken_alone, UPath(tmp_path / "none"), {}, leave_out_broken=True)


def packed_until_killed(before, out, seconds: float) -> bool:
    """Pack in a process of its own, killed after `seconds`; whether it was."""
    process = os.fork()
    if not process:
        pack(before, out, chunk_bytes=1)
        os._exit(0)
    time.sleep(seconds)
    os.kill(process, signal.SIGKILL)
    return os.waitpid(process, 0)[1] == signal.SIGKILL


def test_a_killed_packing_goes_on(tmp_path):
    before = source(many(tmp_path / "scenes", 40))
    out, killed = tmp_path / "chunks", 0
    while not (out / "train" / "index.json").exists():
        killed += packed_until_killed(before, out, 0.03 + 0.02 * killed)
    if (out / "packing.json").exists():
        pack(before, out, chunk_bytes=1)
    assert killed > 1
    after = packed(out)
    assert len(after.scenes("train")) == 40
    assert all(len(scene.images([1])) for scene in after.scenes("train"))


def command(*words) -> str:
    result = run_qgs("data", "pack", *words)
    assert result.exit_code == 0, result.output
    return result.output


def test_the_command(tmp_path):
    scenes, out, small = many(tmp_path / "scenes"), tmp_path / "out", tmp_path / "small"
    told = command(scenes, "--out", out, "--test-every", "3", "--set", "holdout=0")
    assert "scenes 4 train, 2 test; 12 images now, 12 kept" in told
    assert packed(out).scenes("train")[0].held_out == ()
    told = command(out, "--out", small, "--image-size", 8, 12, "--jpeg", "80")
    assert "scenes 4 train, 2 test; 12 images now, 0 kept as they were, 12 written" in told
    assert packed(small, size=(8, 12)).scenes("test")[0].encoded(0).size == (8, 12)


def test_the_command_packs_the_data_of_a_recipe(tmp_path):
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text(
        "recipe: 1\nplugins: [rooms]\n"
        "data: {type: rooms/procedural, scenes: 2, test_scenes: 1, views_per_scene: 2, "
        "image_size: [16, 16]}\n"
    )
    command(recipe, "--out", tmp_path / "chunks")
    after = packed(tmp_path / "chunks", size=(16, 16))
    before = resolve(recipe).build_data()
    for split in ("train", "test"):
        for one, other in zip(before.scenes(split), after.scenes(split), strict=True):
            same(one, other, 1e-6)


@pytest.fixture(params=["{}", "file://{}", "memory://urls{}"])
def folder(request, tmp_path) -> UPath:
    return opened_path(request.param.format(tmp_path / "folder"))
