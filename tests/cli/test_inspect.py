"""`qgs list`, `compose`, `schema`, and what the command does with mistakes."""

import sys

import pytest
from commands import run_qgs

from qgs.cli import main
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


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("queries", ["model.queries: qgs/latent, query-gaussians 0", "locus/anchored"]),
        ("qgs/latent", ["count | integer >= 1 | 4096 | N, the number of queries."]),
        ("locus/anchored", ["center_init.std", "provides: anchor.center (3 float32, world frame)"]),
        ("qgs/photos", ["path | text | required |"]),
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
    assert "a.yaml:12: optimizer.parts.encodr" in str(result.exception)
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
