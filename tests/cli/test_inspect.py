"""`qgs list`, `compose`, `diff`, `schema`, and what the command does with mistakes."""

import json
import re
import sys
from dataclasses import replace
from io import StringIO

import pytest
from commands import run_qgs
from rich.console import Console

from qgs.cli import main
from qgs.cli.tables import difference_tables
from qgs.composer import resolve

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


@pytest.fixture
def recipe(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    (tmp_path / "a.yaml").write_text(SMALL)
    return "a.yaml"


def run(*arguments: str) -> str:
    result = run_qgs(*arguments)
    assert result.exit_code == 0, result.output
    return result.output


def test_list_names_every_component_below_the_path_of_its_slot(recipe):
    output = run("list")
    for title in ("model.decoder.cross_attention (default qgs/content)", "model.queries (def"):
        assert title in output
    assert re.search("qgs/mlp .*GELU.* query-gaussians 0", output)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("queries", ["model.queries: qgs/latent, query-gaussians 0", "locus/anchored"]),
        ("model.decoder.cross_attention", ["cross_attention: qgs/content"]),
        ("qgs/latent", ["count | integer >= 1 | 4096 | N, the number of queries."]),
        ("qgs/content", ["cross_attention: qgs/content", "self_attention: qgs/content"]),
        ("locus/anchored", ["center_init.std", "provides: anchor.center (3 float32, world frame)"]),
        ("locus/ray_biased", ["requires: memory.keys (D/h float32);"]),
        ("qgs/photos", ["path | text | required |"]),
        ("views", ["frame | first_cam or mean_cam | first_cam | The camera"]),
        ("model.decoder", ["layer_scale | number > 0 | 5.0e-05"]),
        ("recipe", ["seed", "init_from"]),
    ],
)
def test_list_explains_options(recipe, name, words):
    output = " ".join(run("list", name).replace("\N{BOX DRAWINGS LIGHT VERTICAL}", "|").split())
    for part in words:
        assert part in output
    assert "qgs/mlp" not in output


def test_compose_refuses_a_part_to_learn_slower_that_is_not_there(recipe, tmp_path):
    (tmp_path / "a.yaml").write_text(SMALL + "optimizer:\n  parts:\n    encodr: 0.1\n")
    result = run_qgs("compose", recipe)
    assert str(result.exception) == (
        "1 problem in the recipe\na.yaml:12: optimizer.parts.encodr\n"
        "  why: the pattern `encodr` matches no parameter of the model\n"
        "  fix: did you mean `encoder`?"
    )
    assert not result.stdout


def test_compose_prints_a_recipe_that_composes_again(recipe, tmp_path):
    result = run_qgs("compose", recipe, "--set", "model.queries.count=5")
    assert result.exit_code == 0, result.output
    text, parameters = result.stdout, result.stderr
    assert "--set #1" in text
    assert "a.yaml:3" in text
    (tmp_path / "again.yaml").write_text(text)
    first = resolve(recipe, ["model.queries.count=5"])
    assert resolve("again.yaml").tree == first.tree
    total = sum(p.numel() for p in first.build_model("meta").parameters())
    assert f"{total:,}" in parameters


def test_diff_shows_what_differs(recipe, tmp_path):
    overlay = "recipe: 1\nextends: a.yaml\nmodel: {queries: {count: 7}}\n"
    (tmp_path / "b.yaml").write_text(overlay)
    output = run("diff", recipe, "b.yaml")
    assert "model.queries.count" in output
    assert "model.width" not in output
    assert f"{3 * 16:+,}" in output


def test_diff_fits_into_80_columns(recipe, tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    (tmp_path / "b.yaml").write_text(
        "recipe: 1\nextends: a.yaml\nplugins: [locus]\nmodel:\n"
        "  queries: {type: locus/anchored, count: 4}\n"
        "  decoder: {cross_attention: {type: locus/ray_biased}, feed_forward: {ratio: 3}}\n"
    )
    output = run("diff", recipe, "b.yaml")
    slots, options = output.split("options that differ")
    assert max(map(len, output.splitlines())) <= 80
    assert "\N{HORIZONTAL ELLIPSIS}" not in output
    assert "slots that differ" in slots
    assert "locus/anchored" in slots
    assert "model.decoder.feed_forward.ratio" in options
    assert "model.decoder.cross_attention.gamma_init" in options, "those of a swapped slot too"


def test_diff_of_one_recipe_with_overrides(recipe):
    count = "model.queries.count={}".format
    output = run("diff", recipe, recipe, "--set-a", count(5), "--set-b", count(6))
    assert "model.queries.count" in output
    assert "model.head" not in output
    assert output.count(" a (2) ") == 3, "the columns of each table"


def test_words_in_brackets_are_not_taken_for_styles():
    console = Console(width=200, record=True, file=StringIO())
    one, other = resolve({"recipe": 1}), resolve({"recipe": 1})
    other = replace(other, tree={**other.tree, "plugins": ["red"]})
    console.print(difference_tables(one, other, "a", "b")[1])
    assert "[red]" in console.export_text()


def test_schema_goes_to_a_file(recipe, tmp_path):
    run("schema", "--out", "schema.json")
    assert "model" in json.loads((tmp_path / "schema.json").read_text())["properties"]
    assert [path.name for path in tmp_path.glob("*.partial")] == []


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["compose", "a.yaml", "--set", "model.queries.cuont=5"], "did you mean `count`"),
        (["compose", "absent.yaml"], "absent.yaml does not exist"),
        (["list", "querys"], "did you mean `queries`"),
    ],
)
def test_mistakes_are_printed_without_a_traceback(arguments, words, recipe, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["qgs", *arguments])
    monkeypatch.delenv("QGS_DEBUG", raising=False)
    with pytest.raises(SystemExit) as caught:
        main()
    assert caught.value.code == 2
    error = capsys.readouterr().err
    assert words in error
    assert "Traceback" not in error


def test_debug_shows_where_it_was_raised(recipe, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["qgs", "compose", "absent.yaml"])
    monkeypatch.setenv("QGS_DEBUG", "1")
    with pytest.raises(ValueError, match=r"absent\.yaml"):
        main()
