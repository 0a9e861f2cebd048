"""Every mistake gets one problem with file, line and path; bases, overrides and mappings too."""

from itertools import pairwise
from pathlib import Path

import pytest
from refusals import refused

from qgs.composer import RecipeError, resolve

# name, line, path, a key word of the reason or fix, text below `recipe: 1`
BROKEN = (
    ("misspelt key", 3, "model.quereis", "`queries`", "model:\n  quereis: {count: 3}\n"),
    ("misspelt option", 4, "model.queries.cuont", "`count`", "model:\n  queries:\n    cuont: 3\n"),
    ("key in the wrong section", 2, "queries", "`model.queries`", "queries: {count: 3}\n"),
    ("misspelt component", 3, "model.queries.type", "`qgs/latent`",
     "model:\n  queries: {type: qgs/latnet}\n"),
    ("component of another slot", 3, "model.queries.type", "slot",
     "model:\n  queries: {type: qgs/mlp}\n"),
    ("missing plugin", 2, "plugins.0", "installed", "plugins: [absent]\n"),
    ("plugin installed but not listed", 3, "model.queries.type", "[spatial]",
     "model:\n  queries: {type: spatial/placed}\n"),
    ("wrong type", 3, "model.queries.count", "'many'", "model:\n  queries: {count: many}\n"),
    ("unmet requirement", 6, "model.decoder.cross_attention", "place.radius",
     "plugins: [spatial]\nmodel:\n  queries: {type: spatial/placed, radius: false}\n  decoder:\n"
        "    cross_attention: {type: spatial/near}\n"),
    ("requirement met too late", 6, "model.decoder.cross_attention", "too late",
     "plugins: [spatial]\nmodel:\n  queries: {type: spatial/placed, radius: false}\n  decoder:\n"
        "    cross_attention: {type: spatial/near}\n    refinement: {type: spatial/measure}\n"),
    ("fields of different frames", 6, "model.decoder.refinement", "camera",
     "plugins: [spatial]\nmodel:\n  queries: {type: spatial/placed}\n  decoder:\n"
        "    refinement: {type: spatial/local}\n"),
    ("duplicate key", 4, "model.width", "recipe.yaml:3", "model:\n  width: 64\n  width: 128\n"),
    ("swap that matches nothing", 3, "swap.decoder.layer.*.cross_attention", "`decoder.layers.",
     "swap:\n  decoder.layer.*.cross_attention: {type: qgs/content}\n"),
    ("two swaps on one place", 4, "swap.decoder.layers.3.cross_attention", "already",
     "swap:\n  decoder.layers.*.cross_attention: {type: qgs/content}\n"
        "  decoder.layers.3.cross_attention: {type: qgs/content}\n"),
    ("swap without a type", 3, "swap.decoder.layers.*.feed_forward", "type",
     "swap:\n  decoder.layers.*.feed_forward: {ratio: 2}\n"),
    ("off", 3, "model.head.norm", "`false`", "model:\n  head: {norm: off}\n"),
    ("tab", 3, "", "tab", "model:\n\twidth: 64\n"),
    ("no YAML", 3, "", "YAML", "model: {width: 64\nseed: 3\n"),
    ("empty file", 1, "", "empty", ""),
    ("a list at the top", 1, "", "list", "- recipe: 1\n"),
    ("a list where a mapping belongs", 3, "model.decoder", "list",
     "model:\n  decoder:\n    - depth: 3\n"),
    ("import path in type", 3, "model.queries.type", "import path",
     "model:\n  queries: {type: torch.nn.Linear}\n"),
    ("python tag", 2, "seed", "python/object", "seed: !!python/object/apply:os.getcwd []\n"),
    ("merge key", 3, "model.<<", "merge", "model:\n  <<: {width: 64}\n"),
    ("negative count", 4, "model.queries.count", "4096", "model:\n  queries:\n    count: -4\n"),
    ("heads that do not divide the width", 4, "model.heads", "128",
     "model:\n  width: 128\n  heads: 5\n"),
    ("image size that the patch does not divide", 4, "model.encoder.patch_size", "64 x 64",
     "plugins: [spatial]\nmodel:\n  encoder: {patch_size: 7}\ndata: {type: spatial/scenes}\n"),
    ("supervised layer beyond the decoder", 4, "model.supervision.layers", "[4]",
     "model:\n  decoder: {depth: 3}\n  supervision: {layers: [2, 4]}\n"),
    ("override of a layer that does not exist", 5, "model.decoder.layers.12", "0 to 11",
     "model:\n  decoder:\n    layers:\n      12: {feed_forward: {ratio: 2}}\n"),
    ("missing recipe version", 1, "recipe", "missing", "seed: 1\n"),
    ("newer recipe version", 1, "recipe", "1", "recipe: 2\n"),
    ("a truth value as version", 1, "recipe", "true", "recipe: true\n"),
    ("data without a type", 2, "data.type", "qgs/photos", "data: {image_size: [64, 64]}\n"),
    ("loss without a type", 3, "losses.mine.type", "type", "losses:\n  mine: {weight: 0.1}\n"),
    ("too few items", 2, "views.gap", "2 items", "views: {gap: [5]}\n"),
    ("gap in the wrong order", 3, "views.gap", "[4, 9]", "views:\n  gap: [9, 4]\n"),
    ("far before near", 5, "model.renderer.far", "near",
     "model:\n  renderer:\n    near: 3\n    far: 2\n"),
    ("supervised layers in the wrong order", 2, "model.supervision.layers", "[2, 4]",
     "model: {supervision: {layers: [4, 2, 2]}}\n"),
    ("type that is a list", 3, "model.queries.type", "list",
     "model:\n  queries: {type: [qgs/latent]}\n"),
    ("swap of a layer that has its own", 8, "swap.decoder.layers.*.feed_forward", "recipe.yaml:6",
     "model:\n  decoder:\n    layers:\n      3:\n        feed_forward: {ratio: 2}\n"
        "swap:\n  decoder.layers.*.feed_forward: {type: qgs/mlp}\n"),
    ("swap dropped that nobody made", 3, "swap.decoder.layers.*.feed_forward", "inherited",
     "swap:\n  decoder.layers.*.feed_forward: null\n"),
    ("plugin listed twice", 2, "plugins.1", "already", "plugins: [spatial, spatial]\n"),
    ("two unmet requirements", 5, "model.decoder.cross_attention", "`spatial/placed`",
     "plugins: [spatial]\nmodel:\n  decoder:\n    cross_attention: {type: spatial/near}\n"),
    ("data without losses", 2, "losses", "loss",
     "losses: {photometric: null, visibility: null}\n"
        "data: {type: qgs/photos, path: photos}\n"),
    ("missing base", 2, "extends", "bases.yaml", "extends: bases.yaml\n"),
    ("aliases of aliases", 3, "", "values", "seed:\n- &a [1, 1, 1, 1, 1, 1, 1, 1, 1]\n"
     + "".join(f"- &{b} [{', '.join([f'*{a}'] * 9)}]\n" for a, b in pairwise("abcdefg"))),
    ("alias inside itself", 3, "", "levels", "seed:\n  &a [*a]\n"),
    ("nested too deep", 3, "", "levels", "seed:\n  " + "[" * 70 + "]" * 70 + "\n"),
    ("nested deeper than Python's stack", 1, "", "deep", "seed: " + "[" * 5000),
)  # fmt: skip
WITHOUT_HEAD = (
    "missing recipe version",
    "newer recipe version",
    "a truth value as version",
    "empty file",
    "a list at the top",
)


@pytest.mark.parametrize("row", BROKEN, ids=lambda row: row[0])
def test_a_mistake_is_one_problem_at_its_place(row, write, spatial):
    name, line, path, word, text = row
    problem = refused(write(text if name in WITHOUT_HEAD else f"recipe: 1\n{text}"))
    assert (problem.file, problem.line, problem.option) == ("recipe.yaml", line, path)
    assert word in problem.reason + problem.fix
    assert f"recipe.yaml:{line}" in str(problem)


def test_all_errors_come_together_sorted_by_line(write, spatial):
    recipe = write("""
        recipe: 1
        plugins: [absent]
        model:
          width: 128
          width: 256
          queries: {count: -1, std: off, typo: 1}
          decoder: {feed_forward: {type: qgs/content}}
        training: {stesp: 5}
    """)
    with pytest.raises(RecipeError) as caught:
        resolve(recipe, ["model.head.norm=3"])
    found = [(problem.file, problem.line, problem.option) for problem in caught.value.problems]
    assert found == [
        ("--set #1", 0, "model.head.norm"),
        ("recipe.yaml", 2, "plugins.0"),
        ("recipe.yaml", 5, "model.width"),
        ("recipe.yaml", 6, "model.queries.count"),
        ("recipe.yaml", 6, "model.queries.std"),
        ("recipe.yaml", 6, "model.queries.typo"),
        ("recipe.yaml", 7, "model.decoder.feed_forward.type"),
        ("recipe.yaml", 8, "training.stesp"),
    ]
    assert str(caught.value).startswith("8 problems")


def test_a_mistake_in_an_extended_file_is_found_there(write):
    write("recipe: 1\nmodel:\n  queries: {count: 0}\n", "base.yaml")
    recipe = write("recipe: 1\nextends: base.yaml\nmodel:\n  queries: {std: 0.5}\n")
    problem = refused(recipe)
    assert (problem.file, problem.line) == ("base.yaml", 3)


def test_an_unmet_requirement_is_found_where_the_reader_is_chosen(write, spatial):
    write("recipe: 1\nplugins: [spatial]\nmodel:\n  queries: {type: spatial/placed}\n"
          "  decoder: {cross_attention: {type: spatial/near}}\n", "base.yaml")  # fmt: skip
    overlay = write("recipe: 1\nextends: base.yaml\nmodel: {queries: {type: qgs/latent}}\n")
    problem = refused(overlay)
    assert (problem.file, problem.line) == ("base.yaml", 5)
    assert "`spatial/placed`" in problem.fix


def test_recipes_that_extend_each_other_in_a_circle(write):
    for name, base in ("ab", "bc", "ca"):
        write(f"recipe: 1\nextends: {base}.yaml\n", f"{name}.yaml")
    problem = refused("a.yaml")
    assert (problem.file, problem.line, problem.option) == ("c.yaml", 2, "extends")
    assert "a.yaml -> b.yaml -> c.yaml -> a.yaml" in problem.reason


def test_a_missing_file_suggests_its_neighbour_but_not_its_reader(write):
    write("recipe: 1\n", "base.yaml")
    for recipe in ("bas.yaml", {"recipe": 1, "extends": "bas.yaml"}):
        assert "`base.yaml`" in refused(recipe).fix
    missing, key = problems_of(write("recipe: 1\nextends: recipes.yaml\nmodle: {}\n"))
    assert "recipe.yaml" not in missing.fix
    assert key.option == "modle"


def problems_of(recipe):
    with pytest.raises(RecipeError) as caught:
        resolve(recipe)
    return caught.value.problems


@pytest.mark.parametrize("content", [None, b"recipe: \xff\n"], ids=["a folder", "no UTF-8"])
def test_what_is_no_text_file(content, tmp_path):
    path = tmp_path / "recipe.yaml"
    path.mkdir() if content is None else path.write_bytes(content)
    assert refused(path).file == str(path)


@pytest.mark.parametrize(
    ("override", "path"),
    [
        ("model.queries.count", "model.queries.count"),
        ("model..count=3", "model..count"),
        ("model.queries.count=[1", "model.queries.count"),
        ("model.queries.count=x", "model.queries.count"),
        ("extends=a.yaml", "extends"),
    ],
)
def test_broken_override(override, path, write):
    problem = refused(write("recipe: 1\n"), ["seed=1", override])
    assert (problem.file, problem.option) == ("--set #2", path)


def test_mappings_that_no_yaml_holds():
    knot: dict = {"recipe": 1}
    knot["model"] = knot
    for recipe in (knot, {"recipe": 1, "seed": object()}, {"recipe": 1, "seed": b"1"}):
        assert refused(recipe).file == "<mapping>"
    assert resolve({"recipe": 1, "init_from": Path("a")}).init_from == "a"
