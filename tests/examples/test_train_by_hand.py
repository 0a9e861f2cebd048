"""docs/examples/train_by_hand.py trains, writes a scene and a checkpoint, and stays short."""

import re
import runpy
from pathlib import Path

import qgs
from qgs.recipe import resolve
from qgs.recipe.recipe import annotated

EXAMPLE = Path(__file__).parents[2] / "docs/examples/train_by_hand.py"


def test_it_is_short_trains_and_saves_a_scene(tmp_path, monkeypatch, capsys):
    assert len(EXAMPLE.read_text().splitlines()) <= 120
    recipe = tmp_path / "recipe.yaml"
    out = tmp_path / "scene.ply"
    smaller = ["model.queries.count=64", "data.image_size=[32, 32]"]
    recipe.write_text(annotated(resolve("tiny/locus.yaml", smaller)))
    command = [EXAMPLE, recipe, 11, out]
    monkeypatch.setattr("sys.argv", [str(argument) for argument in command])
    runpy.run_path(str(EXAMPLE), run_name="__main__")
    first, last = re.findall(r"loss (\S+)", capsys.readouterr().out)
    assert float(last) < float(first)
    assert qgs.load_ply(out).count == 64 * 8
    assert qgs.load(out.with_suffix(".safetensors")).queries.count == 64
