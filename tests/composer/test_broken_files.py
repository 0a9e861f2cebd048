"""Mistakes in what a recipe extends, in overrides and in mappings."""

import pytest
from refusals import refused

from qgs.composer import RecipeError, resolve
from qgs.composer.decode import SETTINGS
from qgs.composer.slots import MOVED


def test_overrides_given_as_one_string():
    with pytest.raises(RecipeError, match="overrides are a list of strings"):
        resolve({"recipe": 1}, "seed=1")


def test_mapping_that_contains_itself():
    recipe: dict = {"recipe": 1}
    recipe["model"] = recipe
    with pytest.raises(RecipeError, match="contains itself"):
        resolve(recipe)


def test_missing_base_suggests_neither_its_reader_nor_something_else(write):
    write("recipe: 1\n", "zebra.yaml")
    recipe = write("recipe: 1\nextends: recipes.yaml\nmodle: {}\n")
    with pytest.raises(RecipeError) as caught:
        resolve(recipe)
    base, key = caught.value.problems
    assert base.fix.startswith("check the path")
    assert key.option == "modle"


def test_missing_base_of_a_mapping(write):
    write("recipe: 1\n", "base.yaml")
    problem = refused({"recipe": 1, "extends": "bases.yaml"})
    assert problem.option == "extends"
    assert "did you mean `base.yaml`" in problem.fix
    assert "working directory" in problem.fix


def test_cycle_is_named_with_its_whole_chain(write):
    write("recipe: 1\nextends: b.yaml\n", "a.yaml")
    write("recipe: 1\nextends: c.yaml\n", "b.yaml")
    write("recipe: 1\nextends: a.yaml\n", "c.yaml")
    problem = refused("a.yaml")
    assert (problem.file, problem.line, problem.option) == ("c.yaml", 2, "extends")
    assert "a.yaml -> b.yaml -> c.yaml -> a.yaml" in problem.reason
    assert "remove" in problem.fix


def test_an_unmet_requirement_names_the_line_of_the_overlay_that_caused_it(write, spatial):
    write(
        """
        recipe: 1
        plugins: [spatial]
        model:
          queries: {type: spatial/placed}
          decoder: {cross_attention: {type: spatial/near}}
        """,
        "base.yaml",
    )
    overlay = write("recipe: 1\nextends: base.yaml\nmodel: {queries: {type: qgs/latent}}\n")
    problem = refused(overlay)
    assert (problem.file, problem.line) == ("base.yaml", 5)
    assert problem.reason.endswith("; model.queries is `qgs/latent` (recipe.yaml:3)")
    assert problem.fix == "use `spatial/placed` in the slot `queries`"


@pytest.mark.parametrize("path", [path for path in MOVED if "." in path])
def test_keys_that_moved_are_told_where_they_went(path, write):
    section, key = path.split(".")
    if key in SETTINGS[section,].model_fields:
        pytest.skip("it has not moved yet")
    problem = refused(write(f"recipe: 1\n{section}: {{{key}: 1}}\n"))
    assert (problem.line, problem.option) == (2, path)
    assert problem.fix == f"write `{MOVED[path]}`"


def test_mistake_in_an_extended_file_is_found_there(write):
    write("recipe: 1\nmodel:\n  queries: {count: 0}\n", "base.yaml")
    recipe = write("recipe: 1\nextends: base.yaml\nmodel:\n  queries: {std: 0.5}\n")
    problem = refused(recipe)
    assert (problem.file, problem.line) == ("base.yaml", 3)


@pytest.mark.parametrize(
    ("override", "path", "reason"),
    [
        ("model.queries.count", "model.queries.count", "is no override"),
        ("model..count=3", "model..count", "is no override"),
        ("model.queries.count=[1", "model.queries.count", "no valid YAML"),
        ("model.queries.count=x", "model.queries.count", "must be a valid integer"),
        ("extends=a.yaml", "extends", "cannot set"),
    ],
)
def test_broken_override(override, path, reason, write):
    problem = refused(write("recipe: 1\n"), ["seed=1", override])
    assert (problem.file, problem.option) == ("--set #2", path)
    assert reason in problem.reason
