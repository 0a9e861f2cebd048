"""The `qgs` command; heavy imports wait until one of its commands runs."""

import os
import sys
from importlib.metadata import EntryPoint
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

from qgs import DISTRIBUTIONS
from qgs.cli import evaluate, inspect, reconstruct, train
from qgs.extensions import installed
from qgs.terminal import show_safely

GROUP = "qgs.commands"
"""Group of entry points NAME = "module:app", where `app` is a `typer.Typer`."""

HELP = {
    "data": "Check and pack data sets.",
    "view": "Turn a reconstruction in the browser, pick a query, see its anchor and what it reads.",
    "scene": (
        "The best scene of photos in a given time: scene.ply, scene.splat, a page, held-out scores."
    ),
    "poses": "Camera poses of photos or a video, by COLMAP: sparse/0 and images, checked at once.",
    "video": "A camera path through Gaussians, as mp4 or webp.",
    "demo": "Trained models on rooms unseen in training, or on your photos; writes report.html.",
    "report": "Evaluate trained models and show their scenes side by side; writes report.html.",
    "figures": "Figures of trained models for a paper, as PDF and PNG.",
    "diff": "Which slots and options of two recipes differ, and what that costs in parameters.",
    "compare": "Compare the results of the first RUN with those of each other, scene by scene.",
    "study": (
        "Train every variant with every seed, evaluate all by one protocol, and compare the scores."
    ),
    "bench": "Size, latency and memory of models: any number of recipes in turn.",
    "convert": "Write Gaussians as PLY, .splat or in a plugin's format.",
    "export": "Write a checkpoint as one new file, with --half at half the size.",
    "import": "Turn published weights into a checkpoint; every tensor is accounted for.",
    "new-plugin": "Write a plugin to start from: one component, its contract tests, a recipe.",
    "check-plugin": "Test every component of a plugin against its contract.",
}
"""Help of the commands of this repository's other distributions; entry points hold none."""


class CommandGroup(TyperGroup):
    """Our own commands, then those of installed distributions, which never hide one of ours."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Names, our own first."""
        own = super().list_commands(ctx)
        return [*own, *sorted({entry.name for entry in installed(GROUP)} - {*own})]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """The command of that name; one of a distribution is not imported yet."""
        own = super().get_command(ctx, cmd_name)
        if own is not None:
            return own
        if offers := [entry for entry in installed(GROUP) if entry.name == cmd_name]:
            return OfferedCommand(cmd_name, offers)
        if missing := DISTRIBUTIONS[GROUP].get(cmd_name):
            raise ValueError(f"`qgs {cmd_name}` is not installed: run `pip install {missing}`")
        return None


class OfferedCommand(TyperCommand):
    """A distribution's command: help from metadata, its code imported when it runs."""

    def __init__(self, name: str, offers: list[EntryPoint]) -> None:
        self.offers = offers
        dists = [entry.dist for entry in offers if entry.dist]
        self.releases = ", ".join(sorted(f"{dist.name} {dist.version}" for dist in dists))
        own = {DISTRIBUTIONS[GROUP].get(name)} == {dist.name for dist in dists}
        summary = "; ".join(dist.metadata["Summary"] or "Commands" for dist in dists)
        super().__init__(name, help=HELP[name] if own else f"{summary} ({self.releases})")

    def make_context(
        self, info_name: str | None, args: list[str], parent: Any = None, **extra: Any
    ) -> Any:
        """The context of the real command. Raises ValueError where there is none."""
        entry, command = self.offers[0], f"the command `qgs {self.name}` of {self.releases}"
        if len(self.offers) > 1:
            raise ValueError(f"{command} is offered several times; uninstall all but one")
        try:
            app = entry.load()
            assert isinstance(app, typer.Typer), f"it is a {type(app)}, not a typer.Typer"
        except (Exception, SystemExit) as error:
            reason = f"cannot be used: `{entry.value}`: {type(error).__name__}: {error}"
            raise ValueError(f"{command} {reason}; update {self.releases}") from error
        app._add_completion = False  # what it would install completes no command of qgs
        return typer.main.get_command(app).make_context(info_name, args, parent, **extra)


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
    "schema": inspect.schema,
    "recipes": inspect.recipes,
    "train": train.train,
    "eval": evaluate.evaluate,
    "reconstruct": reconstruct.reconstruct,
}
for _name, _command in COMMANDS.items():
    app.command(_name)(_command)


def main() -> None:
    """Run the command line; a user's mistake is printed without a traceback, exit code 2.

    The environment variable QGS_DEBUG=1 shows the traceback.
    """
    show_safely()
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
        message = f"error: {str(error) or type(error).__name__}"
        for line in (message, *notes, "(QGS_DEBUG=1 shows where it was raised)"):
            print(line, file=sys.stderr)
        raise SystemExit(2) from None
