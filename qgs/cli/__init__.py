"""The `qgs` command. Groups of commands register themselves; heavy imports wait for a command."""

from __future__ import annotations

import os
import sys

import typer

from qgs.cli import (
    bench,
    check_plugin,
    demo,
    evaluate,
    inspect,
    new_plugin,
    reconstruct,
    train,
    weights,
)
from qgs.cli.plugin_commands import CommandGroup

app = typer.Typer(
    name="qgs",
    cls=CommandGroup,
    help="Query-based feed-forward 3D Gaussian splatting from composable, checked components.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

_RECIPES = (inspect, train, evaluate, reconstruct, weights, bench, demo)
_PLUGINS = (new_plugin, check_plugin)
for _group in (*_RECIPES, *_PLUGINS):
    _group.register(app)


def main() -> None:
    """Run the command line; a user's mistake is printed without a traceback, exit code 2.

    The environment variable QGS_DEBUG=1 shows the traceback.
    """
    try:
        app()
    except (ValueError, OSError, RuntimeError) as error:
        if not _is_a_users_mistake(error):
            raise
        if os.environ.get("QGS_DEBUG"):
            raise
        for line in (f"error: {error}", *_notes(error)):
            print(line, file=sys.stderr)
        print("(QGS_DEBUG=1 shows where it was raised)", file=sys.stderr)
        raise SystemExit(2) from None


def _notes(error: Exception) -> list[str]:
    """What was added to the message, but for traces of other processes."""
    return [note for note in getattr(error, "__notes__", ()) if "\n" not in note]


def _is_a_users_mistake(error: Exception) -> bool:
    if not isinstance(error, RuntimeError):
        return True
    from qgs.contracts.component import MissingExtraError

    return isinstance(error, MissingExtraError)
