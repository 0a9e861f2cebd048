"""What commands print, those of plugins too, holds no control characters of names and texts."""

import io
import re
import sys
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import pytest
import rich.text
from commands import MODEL
from safetensors.numpy import save_file

from qgs.cli import GROUP, main
from qgs.composer.yaml_text import dump

NAME = "a\x1b[2J\u202eb\x9bc\rd\x07"
RAW = re.compile("[\0-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069]")
RECIPE = {
    "recipe": 1,
    "model": {**MODEL, "renderer": {"type": "qgs/torch"}},
    "plugins": ["rooms"],
    "data": {"type": "rooms/procedural", "image_size": [16, 16], "test_scenes": 1},
    "views": {"inputs": 2, "targets": 2, "gap": [2, 4]},
    "evaluation": {"scenes": 1},
    "training": {"steps": 1},
    "optimizer": {"type": "qgs/adamw", "warmup": 0},
}
FAULTY = f"""
import typer
plugin = typer.Typer()
@plugin.command()
def run(): raise RuntimeError({NAME!r})
"""
MODELS = f"""
from qgs.contracts import Plugin
plugin = Plugin("box", 1, (), models={{"m": {NAME + ".safetensors"!r}}})
"""


@pytest.fixture(autouse=True)
def restored(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rich as it is, after a test that had it show its texts safely."""
    monkeypatch.setattr(rich.text, "strip_control_codes", rich.text.strip_control_codes)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working directory; what is in it is called NAME."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "400")
    Path(f"{NAME}.yaml").write_text(dump(RECIPE))
    Path(NAME).mkdir()
    Path(NAME, "0.png").write_bytes(b"")
    Path(NAME, "transforms.json").write_text('{"frames": [{"file_path": "\\u202e"}]}')
    save_file({}, f"{NAME}.safetensors", {"qgs.format": NAME, "qgs.recipe": NAME})
    return tmp_path


@pytest.mark.parametrize(
    "words",
    [
        ("compose", f"{NAME}.yaml"),
        ("compose", f"{NAME}.yaml", "--set", f"model.{NAME}=1"),
        ("compose", NAME),
        pytest.param(
            ("train", f"{NAME}.yaml", "--out", f"{NAME}-run"), marks=pytest.mark.slow, id="trains"
        ),
        ("train", f"{NAME}.yaml", "--out", NAME),
        ("eval", f"{NAME}.safetensors"),
        ("reconstruct", "rooms/locus-64", NAME, "--out", "out"),
        ("list", NAME),
        ("list", "box/m"),
        ("recipes", NAME),
        ("data", "check", NAME),
        ("data", "check", NAME, "--format", "colmap"),
        ("faulty",),
        (NAME,),
        ("list", f"--{NAME}"),
    ],
)
def test_no_command_prints_control_characters(
    words: tuple[str, ...], folder: Path, install, monkeypatch: pytest.MonkeyPatch
) -> None:
    install("faulty", "faulty", FAULTY, group=GROUP)
    install("box", "box", MODELS)
    monkeypatch.setattr(sys, "argv", ["qgs", *words])
    with redirect_stdout(io.StringIO()) as out, redirect_stderr(out):
        try:
            main()
        except (Exception, SystemExit):
            sys.excepthook(*sys.exc_info())  # type: ignore[arg-type]
    assert RAW.findall(out.getvalue()) == []
    assert r"\u202e" in out.getvalue()
    assert Path(f"{NAME}-run", "checkpoint.safetensors").is_file() == (f"{NAME}-run" in words)
