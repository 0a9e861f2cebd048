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
        offers = [*entry_points(group=GROUP, name=cmd_name)]
        if offers:
            return OfferedCommand(cmd_name, offers)
        if own_distribution := DISTRIBUTIONS[GROUP].get(cmd_name):
            raise ValueError(
                f"the command `qgs {cmd_name}` belongs to {own_distribution}, which is not "
                f"installed: run `pip install {own_distribution}`"
            )
        return None


class OfferedCommand(TyperCommand):
    """A distribution's command: help from metadata, its code imported when it runs."""

    def __init__(self, name: str, offers: list[EntryPoint]) -> None:
        self.offers = offers
        releases = (f"{entry.dist.name} {entry.dist.version}" for entry in offers if entry.dist)
        self.releases = ", ".join(sorted(releases))
        summaries = {entry.dist.metadata["Summary"] for entry in offers if entry.dist}
        told = f"{'; '.join(sorted(filter(None, summaries))) or 'Commands'} ({self.releases})"
        own = self.releases.startswith(f"{DISTRIBUTIONS[GROUP].get(name)} ")
        super().__init__(name, help=HELP[name] if own else told)

    def make_context(
        self, info_name: str | None, args: list[str], parent: Any = None, **extra: Any
    ) -> Any:
        """The context of the real command. Raises ValueError where there is none."""
        entry, command = self.offers[0], f"the command `qgs {self.name}`"
        if len(self.offers) > 1:
            raise ValueError(
                f"several distributions offer {command}: {self.releases}; uninstall all but one"
            )
        try:
            app = entry.load()
        except (Exception, SystemExit) as error:
            raise ValueError(
                f"{command} of {self.releases} cannot be imported from `{entry.value}`: "
                f"{type(error).__name__}: {error}; update {self.releases}"
            ) from error
        if not isinstance(app, typer.Typer):
            raise ValueError(
                f"{command} of {self.releases} is no command: `{entry.value}` is "
                f"{type(app).__name__}, not a typer.Typer; update {self.releases}"
            )
        app._add_completion = False  # what it would install completes no command of qgs
        return typer.main.get_command(app).make_context(info_name, args, parent, **extra)
