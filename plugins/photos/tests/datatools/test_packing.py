"""Chunks read as their source does, however they were packed and interrupted."""

import io
from functools import partial
from pathlib import Path

import photo_formats
import pytest
import torch
from commands import done
from photo_formats import listed_lens, put, write_row
from PIL import Image
from qgs_photos.datasets.chunks import ChunksSource
from qgs_photos.datatools import packing
from tables import assert_equal, assert_near, must_refuse, names_in
from torch.testing import assert_close
from upath import UPath

from qgs.recipe import resolve

SIZE = (24, 32)
GIVEN = listed_lens(60.0, 61.0, 31.0, 25.0, 48, 64)
MASKED = [{}, {"mask_path": "mask.png"}]
KEPT = {
    "png": {},
    "jpg": {"kind": "JPEG"},
    "mpo": {"kind": "MPO"},
    "masks": {"cameras": MASKED},
    "times": {"cameras": [{"time": time} for time in (0.1, 0.2, 0.2, 0.7)]},
    "late": {"cameras": [{"time": time} for time in (1.7e9, 1.7e9, 1.7e9 + 0.01, 0)]},
}
LENS = {"k1": -0.2, "camera_model": "OPENCV"}
CHANGED = {
    "webp": {"kind": "WEBP"},
    "grey": {"convert": "L"},
    "transparent": {"convert": "RGBA"},
    "distorted": {"p1": 0.01, **LENS},
    "distorted masks": {"cameras": MASKED, **LENS},
}
"""Scenes whose photos keep their bytes, and others."""


def noise(seed, kind):
    return Image.fromarray(photo_formats.noise(48, 64, 4, seed=seed)).convert(kind)


def photos(path, frames=4, convert="RGB", **options):
    """A scene of noise in nerfstudio's format, by cameras that stand far apart."""
    write_row(path, [noise(i, convert) for i in range(frames)], 300.7, **GIVEN | options)
    noise(100, "L").save(path / "mask.png")


source = partial(photo_formats.opened, size=SIZE, holdout=3)
packed = partial(photo_formats.opened, size=SIZE, source=ChunksSource)


def pack(photos, out, encoding=None, **options):
    splits = packing.chosen_splits(photos)
    return packing.pack(photos, splits, UPath(out), {"path": "photos"}, encoding, **options)


def same(before, after, tolerance=0.0, split="train"):
    close = partial(assert_equal, atol=1e-4, check_dtype=False)
    for one, other in zip(before.scenes(split), after.scenes(split), strict=True):
        frames = range(len(one))
        assert [*map(one.frame_name, frames)] == [*map(other.frame_name, frames)]
        assert [*one.held_out] == [*other.held_out]
        assert (one.images(frames) - other.images(frames)).abs().max() <= tolerance, one.name
        assert_equal((one.times, one.masks(frames)), (other.times, other.masks(frames)))
        close(one.cameras.intrinsics, other.cameras.intrinsics)
        close(one.cameras.c2w, other.cameras.c2w)


@pytest.fixture(scope="module")
def kinds(tmp_path_factory):
    """A folder of scenes, called as their kinds."""
    root = tmp_path_factory.mktemp("kinds")
    for kind, options in (KEPT | CHANGED).items():
        photos(root / kind, **options)
    return root


@pytest.fixture
def six(here):
    """A source of scenes s0, s1 ... of two photos."""
    for number in range(6):
        photos(here / f"scenes/s{number}", frames=2)
    return source("scenes")


def test_chunks_read_as_their_source_does(kinds, here):
    before = source(kinds, background=(0.2, 0.5, 0.9))
    result = pack(before, here)
    count = len(KEPT) + len(CHANGED)
    assert result.scenes == {"train": count, "test": 0}
    assert result.frames == 4 * count
    assert result.kept == 4 * len(KEPT)
    for split in ("train", "test"):  # the same scenes, for their held-out frames
        same(before, packed(here), split=split)

    entries = torch.load("train/000000.torch", weights_only=True)
    entries = {entry["key"]: entry for entry in entries}
    for kind in KEPT:
        file = kinds / f"{kind}/images/2.png"
        assert bytes(entries[kind]["images"][2].numpy()) == file.read_bytes()
    assert {"url", "timestamps"} <= entries["png"].keys()
    cameras = entries["png"]["cameras"]
    assert_near(cameras[0, :4], [60 / 64, 61 / 48, 31 / 64, 25 / 48])
    c2w = before.scenes("train")[0].cameras.c2w[3].float()
    assert_close(cameras[3, 6:].reshape(3, 4) @ c2w, torch.eye(4)[:3])


def test_copies_of_copies_read_alike_at_urls_resized_and_as_jpeg(kinds, here):
    before = source(kinds)
    for url, encoding, tolerance in (
        (f"memory://packed{here}", None, 0),
        (f"file://{here}/same", None, 0),
        ("png", packing.Encoding(resized=True), 0),
        ("jpeg", packing.Encoding(resized=True, jpeg=90), 0.5),
    ):
        pack(before, url, encoding)
        before = packed(UPath(url))
        same(source(kinds), before, tolerance)
        assert names_in(UPath(url) / "train") == {"000000.torch", "index.json"}
    with Image.open(io.BytesIO(before.scenes("train")[0].record.images[0].numpy())) as image:
        assert image.format == "JPEG"
        assert image.size == (32, 24)


def test_chunks_are_bounded_in_size_and_order_is_kept(six):
    one_scene = 2 * Path("scenes/s0/images/0.png").stat().st_size
    pack(six, "chunks", chunk_bytes=int(2.5 * one_scene))
    after = packed("chunks")
    assert after.names("train") == [f"s{i}" for i in range(6)]
    assert list(map(list, after.groups("train"))) == [[0, 1], [2, 3], [4, 5]]
    files = Path("chunks/train").glob("*.torch")
    assert all(file.stat().st_size < 2.5 * one_scene + 20_000 for file in files)


def test_named_scenes_are_for_testing(six):
    train, test = packing.chosen_splits(six, ["s4", "s1"]).values()
    assert [*train] == ["s0", "s2", "s3", "s5"]
    assert [*test] == ["s1", "s4"]
    must_refuse("1 of 2 test scenes do not exist: gone", packing.chosen_splits, six, ["s1", "gone"])


def test_what_is_there_is_never_overwritten(six):
    put(Path("notes/a.txt"), b"mine")
    pack(six, "chunks")
    must_refuse(r"not empty \(a\.txt\)", pack, six, "notes", kind=FileExistsError)
    must_refuse("never overwrites", pack, six, "chunks", kind=FileExistsError)


def test_scenes_that_cannot_be_read_stop_a_packing_or_are_left_out(six):
    out = Path("chunks")
    image = Path("scenes/s3/images/1.png")
    whole = image.read_bytes()
    image.write_bytes(whole[:200])
    must_refuse(
        r"scene 's3', frame 1 \(images/1\.png\) cannot be read", pack, six, out, chunk_bytes=1
    )
    assert not list(out.rglob("index.json"))
    must_refuse(r"other settings .*'chunk_bytes': 1", pack, six, out, chunk_bytes=2)

    result = pack(six, "others", leave_out_broken=True)
    assert result.scenes["train"] == 5
    assert "images/1.png" in result.left_out["s3"]
    must_refuse("no scene to pack: s3: ", pack, source("scenes/s3"), "none", leave_out_broken=True)

    image.write_bytes(whole)
    six = source("scenes")
    result = pack(six, out, chunk_bytes=1)
    assert result.scenes["train"] == 6
    assert result.resumed == 2
    assert result.frames == 8
    same(six, packed(out))


def test_an_interrupted_packing_goes_on(six):
    out = Path("chunks")
    for last in range(1, 4):

        def interrupted(scene, last=last):
            if scene == f"s{last}":
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            pack(six, out, chunk_bytes=1, progress=interrupted)
        assert len([*out.rglob("*.torch")]) == last
        assert not list(out.rglob("index.json"))
        (out / "train/.000009.torch.1.tmp").touch()  # as a killed process leaves
    result = pack(six, out, chunk_bytes=1)
    assert result.resumed == 3
    assert result.frames == 6
    names = sorted(file.name for file in out.rglob("*.*"))
    assert names == [*(f"00000{number}.torch" for number in range(6)), "index.json"]
    same(six, packed(out))


def command(words):
    return done(f"data pack {words}").output


def test_the_command(six):
    told = command("scenes --out out --test-every 3 --set holdout=0")
    assert "scenes: 4 train, 2 test; images of this run: 12, of which 12 copied" in told
    assert packed("out").scenes("train")[0].held_out == ()
    assert packed("out").names("test") == ["s2", "s5"]
    told = command("out --out small --image-size 8 12 --jpeg 80")
    assert "2 test; images of this run: 12, of which 0 copied unchanged and 12 enc" in told
    assert packed("small", size=(8, 12)).scenes("test")[0].stored_size(0) == (8, 12)


def test_the_command_packs_the_data_of_a_recipe(here):
    recipe = here / "recipe.yaml"
    recipe.write_text(
        "recipe: 1\nplugins: [rooms]\n"
        "data: {type: rooms/procedural, scenes: 2, test_scenes: 1, views_per_scene: 2, "
        "image_size: [16, 16]}\n"
    )
    command(f"{recipe} --out chunks")
    after = packed("chunks", size=(16, 16))
    for split in ("train", "test"):
        same(resolve(recipe).build_data(), after, 1e-6, split)
