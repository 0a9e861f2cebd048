"""Commands import the plugins that are asked for; those that import all say so."""

import sys
from pathlib import Path

import pytest
from commands import MODEL, run_qgs
from qgs_datatools import sources

from qgs.composer.yaml_text import dump


@pytest.mark.parametrize(
    ("words", "imported"),
    [
        ("list", True),
        ("list queries", True),
        ("list qgs/latent", False),
        ("list rooms/locus-64", False),
        ("schema", True),
        ("compose recipe.yaml", False),
        ("recipes", False),
        ("eval absent.safetensors", False),
        ("data check photos", True),
        ("data check photos --format nerfstudio", False),
        ("data check photos --format rooms/absent", False),
        ("data pack photos --out chunks", True),
        ("data pack recipe.yaml --out chunks", False),
        ("--help", False),
        ("data check --help", False),
    ],
)
def test_imported(
    words: str, imported: bool, install, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    install(
        "marked", "marked", "from qgs.contracts import Plugin\nplugin = Plugin('marked', 1, ())"
    )
    monkeypatch.chdir(tmp_path)
    Path("recipe.yaml").write_text(dump({"recipe": 1, "model": MODEL}))
    Path("photos", "other").mkdir(parents=True)
    Path("photos", "transforms.json").write_text("{}")
    sources._imported.cache_clear()
    run_qgs(*words.split())
    assert ("_test_marked" in sys.modules) == imported
    sources._imported.cache_clear()
    if imported:
        name = [
            word for word in words.split() if word in ("list", "schema", "data", "check", "pack")
        ]
        told = " ".join(
            run_qgs(*name, "--help").output.replace("\N{BOX DRAWINGS LIGHT VERTICAL}", " ").split()
        )
        assert "mports every" in told
