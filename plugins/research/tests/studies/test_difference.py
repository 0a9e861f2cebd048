"""`qgs diff` shows where two recipes differ."""

from commands import done


def test_diff_shows_what_differs(tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    (tmp_path / "a.yaml").write_text("recipe: 1\nmodel: {width: 16, heads: 2}\n")
    changes = "model: {queries: {count: 4099}}\nevaluation: {index: '[red]'}\n"
    (tmp_path / "b.yaml").write_text(f"recipe: 1\nextends: a.yaml\n{changes}")
    shown = done(f"diff {tmp_path}/a.yaml {tmp_path}/b.yaml").output
    for words in ("model.queries.count", f"{3 * 16:+,}", "[red]"):
        assert words in shown
    assert "model.width" not in shown
    # A model without layers has no component in them.
    assert "decoder.feed_forward" in done("diff tiny/tokengs.yaml tiny/mvsplat.yaml").output
