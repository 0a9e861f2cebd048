"""The `qgs` command; heavy imports wait until one of its commands runs."""

import os
import sys

import typer

from qgs.cli import evaluate, inspect, reconstruct, train, weights
from qgs.cli.plugin_commands import CommandGroup

app = typer.Typer(
    name="qgs",
    cls=CommandGroup,
    help="Query-based feed-forward 3D Gaussian splatting from composable, checked components.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

COMMANDS = {
    "list": inspect.list_components,
    "compose": inspect.compose,
    "diff": inspect.diff,
    "schema": inspect.schema,
    "recipes": inspect.recipes,
    "train": train.train,
    "eval": evaluate.evaluate,
    "reconstruct": reconstruct.reconstruct,
    "convert": weights.convert,
    "import": weights.import_,
    "export": weights.export,
}
for _name, _command in COMMANDS.items():
    app.command(_name)(_command)


def main() -> None:
    """Run the command line; a user's mistake is printed without a traceback, exit code 2.

    The environment variable QGS_DEBUG=1 shows the traceback.
    """
    try:
        app()
    except (ValueError, OSError, RuntimeError, MemoryError) as error:
        from qgs.contracts.component import MissingExtraError
        from qgs.machine import is_out_of_memory

        if is_out_of_memory(error):
            error.add_note("Out of memory: take fewer or smaller images, a smaller batch or model")
        theirs = not isinstance(error, RuntimeError)
        theirs |= isinstance(error, MissingExtraError) or is_out_of_memory(error)
        if os.environ.get("QGS_DEBUG") or not theirs:
            raise
        # A note of several lines is the traceback of another process.
        notes = [note for note in getattr(error, "__notes__", ()) if "\n" not in note]
        told = f"error: {str(error) or type(error).__name__}"
        for line in (told, *notes, "(QGS_DEBUG=1 shows where it was raised)"):
            print(line, file=sys.stderr)
        raise SystemExit(2) from None
