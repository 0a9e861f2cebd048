"""The options of all commands are a list in a file: a new one is a decision, not an accident."""

from pathlib import Path

import typer
import yaml

from qgs.cli import app

FROZEN = Path(__file__).parent / "options.yaml"
MOST = 14
FEWER = {"reconstruct": 12}


def options_of(command, path=()):
    """Command to the options that it takes, subcommands by `name subcommand`."""
    inside = getattr(command, "commands", None)
    if path == () or inside is not None:
        context = typer.Context(command)
        names = command.list_commands(context)
        found = {}
        for name in names:
            found |= options_of(command.get_command(context, name), (*path, name))
        return found
    options = [option for part in command.params for option in part.opts if option[:2] == "--"]
    return {" ".join(path): [option for option in options if option != "--help"]}


def test_options_are_those_of_the_list():
    found = options_of(typer.main.get_command(app))
    assert found == yaml.safe_load(FROZEN.read_text())
    for command, options in found.items():
        assert len(options) <= FEWER.get(command, MOST), command
