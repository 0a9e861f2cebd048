"""`qgs recipes`, and recipes found by name."""

from pathlib import Path

import pytest
from commands import done

from qgs.recipe import RecipeError, files, resolve

RECIPES = Path(__file__).parents[2] / "recipes"


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def test_all_are_listed_with_what_they_are():
    lines = done("recipes").stdout.splitlines()
    assert len(lines) == len({*RECIPES.rglob("*.yaml")} - {*RECIPES.glob("studies/**/*")})
    meanings = dict(line.split(None, 1) for line in lines)
    assert "TokenGS" in meanings["tiny/tokengs.yaml"]
    assert all(" " in meaning for meaning in meanings.values())


@pytest.mark.parametrize("name", ["tiny/locus.yaml", "recipes/tiny/locus.yaml"])
def test_a_name_stands_for_a_recipe_that_no_file_hides(name):
    recipe = resolve(RECIPES / "tiny/locus.yaml").tree
    assert resolve(name).tree == recipe
    Path("mine.yaml").write_text("recipe: 1\nextends: tiny/locus.yaml\nseed: 5\n")
    assert resolve("mine.yaml").tree == {**recipe, "seed": 5}
    Path(name).parent.mkdir(parents=True)
    Path(name).write_text("recipe: 1\nseed: 7\n")
    assert resolve(name).tree["seed"] == 7


def test_other_names_are_refused():
    for name in ("tiny/lotus.yaml", "../README.md", "../recipes/../README.md"):
        with pytest.raises(RecipeError, match=r"does not exist[^?]*or take one of `qgs recipes`"):
            resolve(name)


def test_a_copy_brings_what_it_extends_and_overwrites_nothing():
    words = ("recipes", "rooms/locus_64.yaml", "--out", "mine")
    done(*words)
    copies = sorted(path.name for path in Path("mine").rglob("*.*"))
    assert copies == ["budget_64.yaml", "locus.yaml", "locus_64.yaml", "tokengs.yaml"]
    copy = Path("mine/rooms/locus_64.yaml")
    own = resolve(copy)
    assert own.tree == resolve("rooms/locus_64.yaml").tree
    assert str(RECIPES) not in "".join(own.provenance.values())
    copy.unlink()
    other = Path("mine/tiny/locus.yaml")
    other.write_text("mine")
    with pytest.raises(FileExistsError):
        done(*words)
    assert other.read_text() == "mine"
    assert not copy.exists()


def test_the_recipes_of_a_wheel_come_first(tmp_path, monkeypatch):
    inside = tmp_path / "qgs" / "recipes" / "tiny"
    inside.mkdir(parents=True)
    (inside / "locus.yaml").write_text("recipe: 1\nseed: 9\n")
    monkeypatch.setattr(files, "__file__", str(tmp_path / "qgs/recipe/files.py"))
    assert resolve("tiny/locus.yaml").tree["seed"] == 9
