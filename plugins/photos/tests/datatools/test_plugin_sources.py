"""Data of a source that a plugin brings is checked and packed as that of qgs is."""

import re

import numpy as np
import photo_formats
import pytest
import tape_source
from commands import done, run_qgs
from qgs_photos.datasets.chunks import ChunksSource
from qgs_photos.datatools.candidates import sources
from tape_source import Tape


@pytest.fixture
def tapes(tmp_path, install):
    install(*tape_source.INSTALLED)
    sources.cache_clear()
    for name in "ab":
        tape_source.write_tape(tmp_path / f"tapes/{name}.tape")
    yield tmp_path / "tapes"
    sources.cache_clear()


def test_check(tapes):
    commands = [f"data check {tapes} --quick --format {kind}" for kind in ("auto", "tapes/tape")]
    for good in map(done, commands):
        assert "2 scenes, 0 errors" in good.output
    refused = str(run_qgs(f"data check {tapes} --format rooms/procedural").exception)
    assert refused.startswith("there is no format 'rooms/procedural': use one of auto, nerfstudio")
    tape_source.write_tape(tapes / "b.tape", np.nan)
    for bad in map(run_qgs, commands):
        assert bad.exit_code == 1
        assert "error: b, frames 0-5 (0 to 5): the pose has NaN" in bad.output


def test_missing_images_are_told_and_counted(tapes, monkeypatch):
    monkeypatch.setattr(Tape, "missing", ("2.png", "4.png"))
    (tapes / "index.json").write_text('{"a": {"context": [0, 6], "target": [2]}}')
    output = run_qgs(f"data check {tapes} --quick").output
    assert re.search("a +tapes/tape +8 +6 +2 ", output)
    assert (
        "error: a: listed images that do not exist: 2.png, 4.png; the numbers of later frames in "
        "an evaluation index are then lower: add the files, or remove them from the list" in output
    )
    assert "has frames 6, but the scene has 0 to 5" in output


def test_a_source_that_fails_is_told_and_the_others_go_on(tapes, monkeypatch):
    cannot = "a, frame 1 (1): the image cannot be decoded (KeyError: 'x')"
    faults = (("images", KeyError("x"), cannot), ("frame_name", RuntimeError("no"), "a: Runtime"))
    for method, error, line in faults:
        whole = getattr(Tape, method)

        def fails(scene, asked, whole=whole, error=error):
            if scene.name == "a" and asked in (1, [1]):
                raise error
            return whole(scene, asked)

        with monkeypatch.context() as patch:
            patch.setattr(Tape, method, fails)
            output = run_qgs(f"data check {tapes} --quick").output
        assert f"error: {line}" in output
        assert re.search("b +tapes/tape +6 +6 +0 ", output)
        assert "2 scenes, 1 error" in output


def test_pack(tapes):
    done(f"data pack {tapes} --out {tapes}/chunks --set image_size=[16,16]")
    scenes = photo_formats.opened(tapes / "chunks", (16, 16), ChunksSource).scenes("train")
    told = [(scene.name, len(scene), scene.held_out) for scene in scenes]
    assert told == [(name, 6, (1, 4)) for name in "ab"]
