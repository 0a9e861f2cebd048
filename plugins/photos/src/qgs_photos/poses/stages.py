"""Stages of a long command: a bar for each, and how long each took."""

from collections.abc import Callable, Mapping
from pathlib import Path
from time import perf_counter
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn


class Stages:
    """Bars of the stages that work in the folder `out`; a name alone where nobody looks."""

    def __init__(self, console: Console, out: Path) -> None:
        self._console = console
        self._out = out
        self._stage = ""
        self._began = 0.0
        self._seconds = dict[str, float]()
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            console=console,
            disable=not console.is_terminal,
        )

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, *rest: object) -> None:
        self._bar.stop()
        if kind is KeyboardInterrupt:
            text = f"{self._out} keeps what is done, and the same command goes on from there"
            self._console.print(f"stopped; {text}", soft_wrap=True, highlight=False, markup=False)

    def begin(self, stage: str, total: int) -> Callable[[int, int], None]:
        """Begin a stage; return what shows how much of it is done, and what there is."""
        self.show(stage, 0, total)
        return lambda done, total: self.show(stage, done, total)

    def show(self, stage: str, done: int, total: int) -> None:
        """Show how far a stage is; a new stage ends the one before."""
        if stage != self._stage:
            self.end()
            self._stage = stage
            self._began = perf_counter()
            self._task = self._bar.add_task(stage, total=total)
            # a log has no bars
            if self._bar.disable:
                self._console.print(f"{stage} ...", highlight=False, markup=False)
        self._bar.update(self._task, completed=done, total=total)

    def end(self) -> Mapping[str, float]:
        """End the last stage; return the seconds of all."""
        if self._stage:
            # a stage may come again: COLMAP begins its mapping anew with easier limits
            before = self._seconds.get(self._stage, 0.0)
            self._seconds[self._stage] = round(before + perf_counter() - self._began, 2)
            self._stage = ""
        return self._seconds
