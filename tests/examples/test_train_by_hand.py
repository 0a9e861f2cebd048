"""docs/examples/train_by_hand.py trains, writes a scene and a checkpoint, and stays short."""

import re
import runpy
from pathlib import Path

import pytest

import qgs

EXAMPLE = Path(__file__).parents[2] / "docs/examples/train_by_hand.py"
MAX_LINES = 120


def test_it_trains_and_saves_a_scene(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    recipe, out = EXAMPLE.parents[2] / "recipes/tiny/locus.yaml", tmp_path / "scene.ply"
    command = [EXAMPLE, recipe, "--steps", "11", "--out", out]
    monkeypatch.setattr("sys.argv", [str(argument) for argument in command])
    runpy.run_path(str(EXAMPLE), run_name="__main__")
    losses = [float(number) for number in re.findall(r"loss (\S+)", capsys.readouterr().out)]
    assert len(losses) == 2
    assert losses[1] < losses[0]
    assert qgs.load_ply(out).count == 2048
    assert qgs.load(out.with_suffix(".safetensors")).queries.count == 256


def test_it_is_short() -> None:
    assert len(EXAMPLE.read_text(encoding="utf-8").splitlines()) <= MAX_LINES
