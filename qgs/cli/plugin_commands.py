"""Commands that other distributions offer: listed by metadata, imported when they are called."""

from __future__ import annotations

from importlib.metadata import EntryPoint, entry_points
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

GROUP = "qgs.commands"
"""Entry points NAME = "module:app", where `app` is a `typer.Typer`."""

DISTRIBUTIONS = {"data": "query-gaussians-datatools"}
"""Commands of this repository's own distributions, named when they are not installed."""


class CommandGroup(TyperGroup):
    """The commands of `qgs`, and those of installed distributions."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Own commands first; a distribution's of the same name never hides one."""
        own = super().list_commands(ctx)
        return [*own, *sorted({entry.name for entry in _entries()} - {*own})]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """The command of that name; one of a distribution is not imported yet."""
        own = super().get_command(ctx, cmd_name)
        if own is not None:
            return own
        offered = [entry for entry in _entries() if entry.name == cmd_name]
        if offered:
            return _Offered(cmd_name, offered)
        if cmd_name in DISTRIBUTIONS:
            raise ValueError(
                f"the command `qgs {cmd_name}` belongs to {DISTRIBUTIONS[cmd_name]}, which is not "
                f"installed: run `pip install {DISTRIBUTIONS[cmd_name]}`"
            )
        return None


class _Offered(TyperCommand):
    """Stands for a distribution's command in the list of commands, and gives way to it."""

    def __init__(self, name: str, entries: list[EntryPoint]) -> None:
        self._entries = entries
        release = ", ".join(sorted(map(_release, entries)))
        super().__init__(name, help=f"Commands of {release}.")

    def make_context(self, info_name: str | None, args: list[str], parent: Any = None, **more: Any):
        """The context of the real command, which is imported here."""
        return self._loaded().make_context(info_name, args, parent, **more)

    def _loaded(self) -> Any:
        if len(self._entries) > 1:
            raise ValueError(
                f"several distributions offer a command `qgs {self.name}`: "
                f"{', '.join(sorted(map(_release, self._entries)))}; uninstall all but one"
            )
        entry = self._entries[0]
        try:
            app = entry.load()
        except Exception as error:
            raise ValueError(
                f"the command `qgs {self.name}` of {_release(entry)} cannot be imported from "
                f"`{entry.value}`: {type(error).__name__}: {error}; update {_release(entry)}"
            ) from error
        if not isinstance(app, typer.Typer):
            raise ValueError(
                f"`{entry.value}` of {_release(entry)} is {type(app).__name__}, not a typer.Typer"
            )
        return typer.main.get_command(app)


def _entries() -> list[EntryPoint]:
    return list(entry_points(group=GROUP))


def _release(entry: EntryPoint) -> str:
    return f"{entry.dist.name} {entry.dist.version}" if entry.dist else "an unknown distribution"
