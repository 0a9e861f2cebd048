"""Data of a source that a plugin brings is checked and packed as that of qgs is."""

import numpy as np
import photo_formats
import pytest
import tape_source
from qgs_datatools import sources
from typer.testing import CliRunner

from qgs.cli import app
from qgs.data import ChunksSource


@pytest.fixture
def tapes(tmp_path, monkeypatch):
    tape_source.install(tmp_path / "site", monkeypatch)
    sources.sources.cache_clear()
    for name in "ab":
        tape_source.write_tape(tmp_path / "tapes" / f"{name}.tape")
    yield tmp_path / "tapes"
    sources.sources.cache_clear()


def run(*arguments):
    return CliRunner().invoke(app, ["data", *map(str, arguments)])


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
    assert "no format 'tape': use one of auto, nerfstudio" in str(
        run("check", tapes, "--format", "tape").exception
    )


def test_pack(tapes, tmp_path):
    packed = run("pack", tapes, "--out", tmp_path / "chunks", "--set", "image_size=[16, 16]")
    assert packed.exception is None, packed.output
    scenes = photo_formats.opened(tmp_path / "chunks", (16, 16), ChunksSource).scenes("train")
    told = [(scene.name, len(scene), tuple(scene.held_out)) for scene in scenes]
    assert told == [("a", 6, (1, 4)), ("b", 6, (1, 4))]
