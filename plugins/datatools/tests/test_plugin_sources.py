"""Data of a source that a plugin brings is checked and packed as that of qgs is."""

import re
from functools import partial

import numpy as np
import photo_formats
import pytest
import tape_source
import torch
from commands import run_qgs
from qgs_datasets.chunks import ChunksSource
from qgs_datatools import sources
from tape_source import Tape

run = partial(run_qgs, "data")


@pytest.fixture
def tapes(tmp_path, monkeypatch):
    tape_source.install(tmp_path / "site", monkeypatch)
    sources._imported.cache_clear()
    for name in "ab":
        tape_source.write_tape(tmp_path / "tapes" / f"{name}.tape")
    yield tmp_path / "tapes"
    sources._imported.cache_clear()


@pytest.mark.parametrize("format", ["auto", "tapes/tape"])
def test_check(tapes, format):
    good = run("check", tapes, "--quick", "--format", format)
    assert good.exit_code == 0, good.output
    assert "2 scenes, 0 errors" in good.output
    with np.load(tapes / "b.tape") as arrays:
        images, c2w = arrays["images"], arrays["c2w"]
    c2w[3] = np.nan
    with (tapes / "b.tape").open("wb") as file:
        np.savez(file, images=images, c2w=c2w)
    bad = run("check", tapes, "--quick", "--format", format)
    assert bad.exit_code == 1
    assert "error: b, frame 3 (3): the pose has NaN" in bad.output
    refused = str(run("check", tapes, "--format", "rooms/procedural").exception)
    assert refused.startswith("there is no format 'rooms/procedural': use one of auto, nerfstudio")


def test_missing_images_are_told_and_counted(tapes, monkeypatch):
    monkeypatch.setattr(Tape, "missing", ("2.png", "4.png"))
    (tapes / "index.json").write_text('{"a": {"context": [0, 6], "target": [2]}}')
    output = run("check", tapes, "--quick").output
    assert re.search("a +tapes/tape +8 +6 +2 ", output)
    assert (
        "error: a: listed images that do not exist: 2.png, 4.png; later frames move up in an "
        "index: add the files, or take them out of what lists them" in output
    )
    assert "context frame 6, but the scene's 6 frames are 0 to 5" in output


@pytest.mark.parametrize("error", [KeyError("x"), RuntimeError("no luck")])
@pytest.mark.parametrize("method", ["images", "frame_name"])
def test_a_source_that_fails_is_told_and_the_others_go_on(tapes, monkeypatch, error, method):
    whole = getattr(Tape, method)

    def fails(scene, asked):
        if scene.name == "a" and asked in (1, [1]):
            raise error
        return whole(scene, asked)

    monkeypatch.setattr(Tape, method, fails)
    output = run("check", tapes, "--quick").output
    told = f"{type(error).__name__}: {error}"
    where = f"a, frame 1 (1): the image cannot be decoded ({told})" if method == "images" else "a: "
    assert f"error: {where}" in output
    assert told in output
    assert re.search("b +tapes/tape +6 +6 +0 ", output)
    assert "2 scenes, 1 error" in output


def test_masks_are_looked_at(tapes, monkeypatch):
    monkeypatch.setattr(Tape, "masks", lambda self, frames: torch.ones(len(frames), 1, 8, 8))
    output = run("check", tapes, "--geometry", 0).output
    reason = "its mask (1, 1, 8, 8) is not of shape (1, 1, 16, 16) and in [0, 1]: replace the mask"
    assert f"error: b, frames 0-5 (0 to 5): {reason}" in output


def test_pack(tapes, tmp_path):
    packed = run("pack", tapes, "--out", tmp_path / "chunks", "--set", "image_size=[16, 16]")
    assert packed.exception is None, packed.output
    scenes = photo_formats.opened(tmp_path / "chunks", (16, 16), ChunksSource).scenes("train")
    told = [(scene.name, len(scene), tuple(scene.held_out)) for scene in scenes]
    assert told == [("a", 6, (1, 4)), ("b", 6, (1, 4))]
