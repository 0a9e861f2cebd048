"""`qgs list`, `compose`, `schema`, and what the command does with mistakes."""

import sys

import pytest
from commands import done

from qgs.cli import main
from qgs.recipe import resolve

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
def _in_a_folder_with_a_recipe(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    (tmp_path / "a.yaml").write_text(SMALL)


LISTED = """
queries; model.queries: qgs/latent, query-gaussians 0; locus/anchored
qgs/latent; count | integer >= 1 | 4096 | N, the number of queries.
locus/anchored; center_init.std; provides: anchor.center (3 float32, world frame)
qgs/photos; path | text | required |
model.decoder; layer_scale | number > 0 | 5.0e-05
recipe; seed; init_from
"""


def test_list_explains_options():
    for line in LISTED.strip().splitlines():
        name, *parts = line.split("; ")
        shown = done("list", name).output.replace("\N{BOX DRAWINGS LIGHT VERTICAL}", "|")
        output = " ".join(shown.split())
        assert all(part in output for part in parts), output
        assert "qgs/mlp" not in output


def test_compose_prints_a_recipe_that_composes_again(tmp_path):
    result = done("compose", "a.yaml", "--set", "model.queries.count=5")
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
"""


def test_mistakes_are_printed_without_a_traceback(tmp_path, monkeypatch, capsys):
    monkeypatch.delenv("QGS_DEBUG", raising=False)
    (tmp_path / "slow.yaml").write_text(SMALL + "optimizer:\n  parts:\n    encodr: 0.1\n")
    for line in MISTAKES.strip().splitlines():
        words, reason = line.split("; ")
        monkeypatch.setattr(sys, "argv", ["qgs", *words.split()])
        with pytest.raises(SystemExit) as caught:
            main()
        assert caught.value.code == 2
        shown = capsys.readouterr()
        assert reason in shown.err
        assert "Traceback" not in shown.err
        assert not shown.out
