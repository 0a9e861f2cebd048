"""`qgs recipes`, and recipes found by name."""

from pathlib import Path

import pytest
from commands import run_qgs

import qgs
from qgs.composer import RecipeError, resolve

RECIPES = Path(__file__).parents[2] / "recipes"


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_all_are_listed_with_what_they_are() -> None:
    lines = run_qgs("recipes").stdout.splitlines()
    assert len(lines) == len({*RECIPES.rglob("*.yaml")} - {*RECIPES.glob("studies/**/*")})
    assert any(
        line.split(None, 1)[0] == "tiny/tokengs.yaml" and "TokenGS" in line for line in lines
    )
    assert all(len(line.split()) > 2 for line in lines)


@pytest.mark.parametrize("name", ["tiny/locus.yaml", "recipes/tiny/locus.yaml"])
def test_a_name_stands_for_a_recipe_that_no_file_hides(elsewhere: Path, name: str) -> None:
    assert resolve(name).tree == resolve(RECIPES / "tiny/locus.yaml").tree
    (elsewhere / "mine.yaml").write_text("recipe: 1\nextends: tiny/locus.yaml\nseed: 5\n")
    assert resolve("mine.yaml").tree == {**resolve(name).tree, "seed": 5}
    (elsewhere / name).parent.mkdir(parents=True)
    (elsewhere / name).write_text("recipe: 1\nseed: 7\n")
    assert resolve(name).tree["seed"] == 7


@pytest.mark.parametrize("name", ["tiny/lotus.yaml", "../README.md", "../recipes/../README.md"])
def test_other_names_are_refused(name: str) -> None:
    with pytest.raises(RecipeError, match=r"does not exist[^?]*or take one of `qgs recipes`"):
        resolve(name)


def test_a_copy_brings_what_it_extends_and_overwrites_nothing(elsewhere: Path) -> None:
    result = run_qgs("recipes", "rooms/locus_64.yaml", "--out", "mine")
    assert result.exit_code == 0, result.output
    copies = sorted(p.relative_to("mine").as_posix() for p in Path("mine").rglob("*.*"))
    names = ["rooms/budget_64.yaml", "rooms/locus_64.yaml", "tiny/locus.yaml", "tiny/tokengs.yaml"]
    assert copies == names
    own = resolve("mine/rooms/locus_64.yaml")
    assert own.tree == resolve("rooms/locus_64.yaml").tree
    assert str(RECIPES) not in "".join(own.provenance.values())
    Path("mine/rooms/locus_64.yaml").unlink()
    Path("mine/tiny/locus.yaml").write_text("mine")
    again = run_qgs("recipes", "rooms/locus_64.yaml", "--out", "mine")
    assert isinstance(again.exception, FileExistsError)
    assert Path("mine/tiny/locus.yaml").read_text() == "mine"
    assert not Path("mine/rooms/locus_64.yaml").exists()


def test_the_recipes_of_a_wheel_come_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    inside = tmp_path / "site" / "qgs" / "recipes" / "tiny"
    inside.mkdir(parents=True)
    (inside / "locus.yaml").write_text("recipe: 1\nseed: 9\n")
    monkeypatch.setattr(qgs, "__file__", str(tmp_path / "site" / "qgs" / "__init__.py"))
    assert resolve("tiny/locus.yaml").tree["seed"] == 9
