"""`qgs diff` shows where two recipes differ."""

from dataclasses import replace
from io import StringIO

from commands import run_qgs
from qgs_studies.difference import difference_tables
from rich.console import Console

from qgs.composer import resolve


def test_words_in_brackets_are_not_taken_for_styles():
    console = Console(width=200, record=True, file=StringIO())
    one = resolve({"recipe": 1})
    other = replace(one, tree={**one.tree, "plugins": ["red"]})
    console.print(difference_tables(one, other, "a", "b")[1])
    assert "[red]" in console.export_text()


def test_diff_shows_what_differs(tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    (tmp_path / "a.yaml").write_text("recipe: 1\nmodel: {width: 16, heads: 2}\n")
    overlay = "recipe: 1\nextends: a.yaml\nmodel: {queries: {count: 4099}}\n"
    (tmp_path / "b.yaml").write_text(overlay)
    result = run_qgs("diff", tmp_path / "a.yaml", tmp_path / "b.yaml")
    assert result.exit_code == 0, result.output
    assert "model.queries.count" in result.output
    assert "model.width" not in result.output
    assert f"{3 * 16:+,}" in result.output
