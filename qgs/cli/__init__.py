"""The program `qgs`. Heavy packages are imported only when one of its commands runs."""

import os
import sys
from importlib.metadata import EntryPoints
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

from qgs.cli import convert, evaluate, inspect, reconstruct, train
from qgs.extensions import INSTALL_ALL, installed, release_of
from qgs.terminal import show_safely
from qgs.wording import did_you_mean, listed

GROUP = "qgs.commands"
"""Entry-point group for commands of plug-ins: NAME = "module:app", with a `typer.Typer` `app`."""


class CommandGroup(TyperGroup):
    """Commands of the core and of plug-ins. A plug-in cannot replace a core command."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names of all commands, core commands first."""
        # Not sorted by the alphabet: a newcomer needs the first commands first.
        own = super().list_commands(ctx)
        return [*own, *sorted(installed(GROUP).names - {*own})]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return the command `cmd_name` of the core or a plug-in; raise ValueError if missing."""
        own = super().get_command(ctx, cmd_name)
        if own is not None:
            return own
        offers = installed(GROUP).select(name=cmd_name)
        if not offers:
            hint = did_you_mean(cmd_name, self.list_commands(ctx), "commands")
            raise ValueError(
                f"there is no command `qgs {cmd_name}`. If it belongs to a plug-in, {INSTALL_ALL}; "
                f"{hint}"
            )
        return offered_command(cmd_name, offers)


def offered_command(name: str, offers: EntryPoints) -> Any:
    """Import the command `name` of a plug-in, and return the command.

    offers: entry points with this name. If there are several, or the import fails, the returned
    command only raises ValueError.
    """
    try:
        (entry,) = offers
        offered = entry.load()
        assert isinstance(offered, typer.Typer), f"its entry is {type(offered)}, not a typer.Typer"
    # Importing runs the distribution's code.
    except (Exception, SystemExit) as error:
        releases = sorted(map(release_of, offers))
        reason = (
            f"the command `qgs {name}` of {listed(releases)} cannot be used: "
            f"{type(error).__name__}: {error}; update it, and keep only one if several are named"
        )

        def refuse() -> None:
            raise ValueError(reason)

        anything = {"ignore_unknown_options": True, "allow_extra_args": True}
        return TyperCommand(name, help=reason, callback=refuse, context_settings=anything)
    # Its shell completion would not work for `qgs`.
    offered._add_completion = False
    command = typer.main.get_command(offered)
    command.name = name
    return command


app = typer.Typer(
    name="qgs",
    cls=CommandGroup,
    help="Query-based feed-forward 3D Gaussian splatting from composable, checked components.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

COMMANDS = {
    "compose": inspect.compose,
    "recipes": inspect.recipes,
    "train": train.train,
    "eval": evaluate.evaluate,
    "reconstruct": reconstruct.reconstruct,
    "convert": convert.convert,
}
for _name, _command in COMMANDS.items():
    app.command(_name)(_command)


def main() -> None:
    """Run the program.

    For a mistake of the user, it prints a message without traceback, and exits with code 2. The
    environment variable QGS_DEBUG=1 shows the traceback.
    """
    # File names and messages from servers may contain control characters.
    show_safely()
    try:
        app()
    except (ValueError, OSError, RuntimeError, MemoryError) as error:
        from qgs.contracts.component import MissingExtraError
        from qgs.machine import is_out_of_memory

        if is_out_of_memory(error):
            error.add_note("Out of memory: use fewer or smaller images, a smaller batch or model")
        theirs = not isinstance(error, RuntimeError)
        theirs |= isinstance(error, MissingExtraError) or is_out_of_memory(error)
        if os.environ.get("QGS_DEBUG") or not theirs:
            raise
        # A note of several lines is the traceback of another process.
        notes = [note for note in getattr(error, "__notes__", ()) if "\n" not in note]
        message = f"error: {str(error) or type(error).__name__}"
        for line in (message, *notes, "(set QGS_DEBUG=1 to see the traceback)"):
            print(line, file=sys.stderr)
        raise SystemExit(2) from None
