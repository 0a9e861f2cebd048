"""What commands print, those of plugins too, holds no control characters of names and texts."""

import json
import re
import sys
from pathlib import Path

import pytest
import rich.text
from commands import ONE_LAYER
from safetensors.numpy import save_file

from qgs.cli import GROUP, main

NAME = "a\x1b[2J\u202eb\x9bc\rd\x07"
RAW = re.compile("[\0-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069]")
RECIPE = f"""
recipe: 1
model: {json.dumps(ONE_LAYER["model"])}
plugins: [rooms]
data: {{type: rooms/procedural, image_size: [16, 16], test_scenes: 1}}
views: {{inputs: 2, targets: 2, gap: [2, 4]}}
evaluation: {{scenes: 1}}
training: {{steps: 1}}
optimizer: {{type: qgs/adamw, warmup: 0}}
"""
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
COMMANDS = """
compose NAME.yaml
compose NAME.yaml --set model.NAME=1
compose NAME
train NAME.yaml --out NAME
eval NAME.safetensors
reconstruct rooms/locus-64 NAME --out out
list NAME
list box/m
recipes NAME
data check NAME
data check NAME --format colmap
faulty
NAME
list --NAME
"""


@pytest.fixture
def printed(install, here, monkeypatch, capsys):
    """What a command prints where all is called NAME."""
    monkeypatch.setenv("COLUMNS", "400")
    Path(f"{NAME}.yaml").write_text(RECIPE)
    Path(NAME).mkdir()
    Path(NAME, "0.png").write_bytes(b"")
    Path(NAME, "transforms.json").write_text('{"frames": [{"file_path": "\\u202e"}]}')
    save_file({}, f"{NAME}.safetensors", {"qgs.format": NAME, "qgs.recipe": NAME})
    install("faulty", "faulty", FAULTY, group=GROUP)
    install("box", "box", MODELS)

    def printed(command):
        with monkeypatch.context() as patch:
            # rich is left as it is
            patch.setattr(rich.text, "strip_control_codes", rich.text.strip_control_codes)
            patch.setattr(sys, "argv", ["qgs", *command.split(" ")])
            try:
                main()
            except (Exception, SystemExit):
                sys.excepthook(*sys.exc_info())
        return "".join(capsys.readouterr())

    return printed


def test_no_command_prints_control_characters(printed):
    texts = {line: printed(line.replace("NAME", NAME)) for line in COMMANDS.strip().splitlines()}
    assert not [command for command, text in texts.items() if RAW.search(text)]
    assert not [command for command, text in texts.items() if r"\u202e" not in text]


@pytest.mark.slow
def test_a_training_prints_none_either(printed):
    text = printed(f"train {NAME}.yaml --out {NAME}-run")
    assert not RAW.search(text)
    assert r"\u202e" in text
    assert Path(f"{NAME}-run/checkpoint.safetensors").is_file()
