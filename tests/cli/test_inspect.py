"""`qgs compose`, `recipes`, names of recipes, options of all commands, mistakes."""

import sys
from pathlib import Path

import pytest
import typer
import yaml
from commands import done
from photo_formats import put
from size import ROOT
from tables import must_refuse, rows

from qgs.cli import app, main
from qgs.recipe import RecipeError, resolve

SMALL = """recipe: 1
model:
  width: 16
  heads: 2
  encoder: {depth: 1}
  queries: {count: 4}
  decoder: {depth: 2}
  head: {gaussians_per_query: 2}
  supervision: {layers: [2]}
"""


@pytest.fixture(autouse=True)
def _in_a_folder_with_a_recipe(here, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    (here / "a.yaml").write_text(SMALL)


def test_compose_prints_a_recipe_that_composes_again(tmp_path):
    result = done("compose a.yaml --set model.queries.count=5")
    assert "--set #1" in result.stdout
    assert "a.yaml:3" in result.stdout
    (tmp_path / "again.yaml").write_text(result.stdout)
    first = resolve("a.yaml", ["model.queries.count=5"])
    assert resolve("again.yaml").tree == first.tree
    total = sum(p.numel() for p in first.build_model("meta").parameters())
    assert f"{total:,}" in result.stderr


MISTAKES = """
compose a.yaml --set model.queries.cuont=5; did you mean `count`
compose absent.yaml; absent.yaml does not exist
compose slow.yaml; slow.yaml:12: optimizer.parts.encodr
list querys; did you mean `queries`
eval absent; absent
bench tiny/tokengs.yaml --size 16; --size must be HxW in pixels, such as 256x448, got '16'
bench tiny/tokengs.yaml --size 16x0; got '16x0'
bench tiny/tokengs.yaml --size 15x24 --device cpu; 15 x 24
bench tiny/tokengs.yaml --precision fp16 --device cpu; fp16
"""


def test_mistakes_are_printed_without_a_traceback(tmp_path, monkeypatch, capsys):
    monkeypatch.delenv("QGS_DEBUG", raising=False)
    (tmp_path / "slow.yaml").write_text(SMALL + "optimizer:\n  parts:\n    encodr: 0.1\n")
    for words, reason in rows(MISTAKES, "; "):
        monkeypatch.setattr(sys, "argv", ["qgs", *words.split()])
        assert must_refuse(None, main, kind=SystemExit).code == 2
        shown = capsys.readouterr()
        assert reason in shown.err
        assert "Traceback" not in shown.err
        assert not shown.out


RECIPES = ROOT / "recipes"


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
    put(Path(name), b"recipe: 1\nseed: 7\n")
    assert resolve(name).tree["seed"] == 7


def test_other_names_are_refused():
    for name in ("tiny/lotus.yaml", "../README.md", "../recipes/../README.md"):
        reason = r"does not exist[^?]*a recipe from `qgs recipes`"
        must_refuse(reason, resolve, name, kind=RecipeError)


def test_a_copy_brings_what_it_extends_and_overwrites_nothing():
    line = "recipes rooms/locus_64.yaml --out mine"
    done(line)
    copies = sorted(path.name for path in Path("mine").rglob("*.*"))
    assert copies == ["budget_64.yaml", "locus.yaml", "locus_64.yaml", "tokengs.yaml"]
    copy = Path("mine/rooms/locus_64.yaml")
    own = resolve(copy)
    assert own.tree == resolve("rooms/locus_64.yaml").tree
    assert str(RECIPES) not in "".join(own.provenance.values())
    copy.unlink()
    other = Path("mine/tiny/locus.yaml")
    other.write_text("mine")
    must_refuse(None, done, line, kind=FileExistsError)
    assert other.read_text() == "mine"
    assert not copy.exists()


def test_the_recipes_of_a_wheel_come_first(tmp_path, monkeypatch):
    put(tmp_path / "qgs/recipes/tiny/locus.yaml", b"recipe: 1\nseed: 9\n")
    monkeypatch.setattr("qgs.recipe.files.__file__", str(tmp_path / "qgs/recipe/files.py"))
    assert resolve("tiny/locus.yaml").tree["seed"] == 9


FROZEN = Path(__file__).parent / "options.yaml"


def options_of(command, path=()):
    """Command to the options that it takes, subcommands by `name subcommand`."""
    if hasattr(command, "commands"):
        found = {}
        context = typer.Context(command)
        for name in command.list_commands(context):
            found |= options_of(command.get_command(context, name), (*path, name))
        return found
    options = [option for part in command.params for option in part.opts if option[:2] == "--"]
    return {" ".join(path): [option for option in options if option != "--help"]}


def test_options_are_those_of_the_list():
    """A new one is a decision, not an accident."""
    assert options_of(typer.main.get_command(app)) == yaml.safe_load(FROZEN.read_text())
