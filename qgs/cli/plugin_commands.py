"""Commands that other distributions offer: listed by metadata, imported when they are called."""

from importlib.metadata import EntryPoint, entry_points
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

from qgs import DISTRIBUTIONS

GROUP = "qgs.commands"
"""Group of entry points NAME = "module:app", where `app` is a `typer.Typer`."""

HELP = {
    "data": "Check and pack data sets.",
    "view": "Turn a reconstruction in the browser, pick a query, see its anchor and what it reads.",
    "demo": "Trained models on rooms that none has seen, or on your photos; writes report.html.",
    "report": "Judge trained models side by side and picture their scenes; writes report.html.",
    "figures": "Figures of trained models for a paper, as PDF and PNG.",
    "compare": "Compare the results of the first RUN with those of each other, scene by scene.",
    "study": (
        "Train every variant with every seed, judge them alike, and answer: better, and how sure?"
    ),
    "bench": "Size, latency and memory of models: any number of recipes in turn.",
    "new-plugin": "Write a plugin to start from: one component, its contract tests, a recipe.",
    "check-plugin": "Hold every component of a plugin to its contract.",
}
"""What the commands of this repository's other distributions do; their entry points cannot tell."""


class CommandGroup(TyperGroup):
    """Our own commands, then those of installed distributions, which never hide one of ours."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Names, our own first."""
        own = super().list_commands(ctx)
        return [*own, *sorted(entry_points(group=GROUP).names - {*own})]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """The command of that name; one of a distribution is not imported yet."""
        own = super().get_command(ctx, cmd_name)
        if own is not None:
            return own
        if offers := [*entry_points(group=GROUP, name=cmd_name)]:
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
