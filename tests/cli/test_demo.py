import re

import pytest
import yaml
from commands import MODEL, run_qgs
from plyfile import PlyData

import qgs
from qgs.cli.contest import resolve_fairly
from qgs.cli.demo import default_recipes, new_folder
from qgs.engine.guard import CollapseError

RECIPE = {
    "recipe": 1,
    "model": MODEL,
    "plugins": ["rooms"],
    "data": {"type": "rooms/procedural", "image_size": [16, 16], "scenes": 4, "test_scenes": 3},
    "views": {"inputs": 2, "targets": 2, "gap": [2, 4], "scale_factor": 0.4},
    "optimizer": {"warmup": 5},
    "training": {"batch_size": 2, "precision": "float32"},
    "evaluation": {"scenes": 2},
}


@pytest.fixture
def recipes(tmp_path):
    """Two recipes that differ in the number of queries."""
    (tmp_path / "few.yaml").write_text(yaml.safe_dump(RECIPE))
    overlay = {"recipe": 1, "extends": "few.yaml", "model": {"queries": {"count": 12}}}
    (tmp_path / "more.yaml").write_text(yaml.safe_dump(overlay))
    return [tmp_path / "few.yaml", tmp_path / "more.yaml"]


def test_recipes_are_trained_compared_and_reported(recipes, tmp_path):
    out = tmp_path / "demo"
    result = run_qgs("demo", *recipes, "--seconds", 1, "--out", out)
    assert result.exception is None
    for name, queries in (("few", 8), ("more", 12)):
        assert (out / name / "checkpoint.safetensors").is_file()
        assert PlyData.read(out / name / "example.ply")["vertex"].count == 4 * queries
        assert name in result.output
    assert "Mean colour" in result.output
    page = (out / "report.html").read_text()
    assert page.count("data:image/png;base64,") > 10
    assert not re.search(r"(src|href)=\"(?!data:|#)", page)
    assert "count: 12" in page


def test_recipes_with_other_data_or_of_one_name_are_not_compared(recipes):
    with pytest.raises(ValueError, match="told apart by file name"):
        resolve_fairly([recipes[0], recipes[0]], seconds=1, seed=0)
    overlay = {"recipe": 1, "extends": "few.yaml", "views": {"gap": [2, 5]}}
    recipes[1].write_text(yaml.safe_dump(overlay))
    with pytest.raises(ValueError, match="more and few differ in views"):
        resolve_fairly(recipes, seconds=1, seed=0)


def test_budget_and_seed_are_those_asked_for(recipes):
    for recipe in resolve_fairly(recipes, seconds=7, seed=3).values():
        assert recipe.training.seconds == 7
        assert recipe.tree["seed"] == 3


def test_recipes_beside_the_user_come_first_and_missing_ones_say_where_they_were_looked_for(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(qgs, "__file__", str(tmp_path / "site-packages" / "qgs" / "__init__.py"))
    with pytest.raises(FileNotFoundError, match=r"recipes/tiny.*--recipe-folder FOLDER"):
        default_recipes(None)
    with pytest.raises(FileNotFoundError, match="elsewhere"):
        default_recipes(tmp_path / "elsewhere")
    files = [tmp_path / "recipes" / "tiny" / name for name in ("tokengs.yaml", "locus.yaml")]
    files[0].parent.mkdir(parents=True)
    for file in files:
        file.touch()
    assert [path.resolve() for path in default_recipes(None)] == files


def test_an_earlier_demo_is_never_touched(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert new_folder(None).name == "demo"
    (tmp_path / "demo").mkdir()
    assert new_folder(None).name == "demo-2"
    (tmp_path / "demo" / "report.html").touch()
    with pytest.raises(FileExistsError, match="not empty"):
        new_folder(tmp_path / "demo")


def test_a_collapse_ends_the_demo_with_its_reason(recipes, tmp_path, monkeypatch):
    def collapse(*_):
        raise CollapseError("training collapsed at step 7")

    monkeypatch.setattr("qgs.cli.contest.compete", collapse)
    out = tmp_path / "demo"
    result = run_qgs("demo", recipes[0], "--out", out)
    assert result.exit_code == 1
    assert "collapsed at step 7" in result.stderr
