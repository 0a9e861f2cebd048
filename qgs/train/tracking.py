"""Experiment trackers, and the progress of a training on the terminal.

A distribution adds a tracker by an entry point in the group `qgs.trackers` that names a `Tracker`.
"""

import logging
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from qgs.contracts import MissingExtraError
from qgs.extensions import INSTALL_ALL, installed, load
from qgs.metrics.images import Psnr
from qgs.wording import listed

_LOG_SECONDS = 15.0

_log = logging.getLogger(__name__)


class Tracker(ABC):
    """A destination of the numbers and pictures of one run, in addition to its folder."""

    package: ClassVar[str] = ""
    """The package that it needs, as Python and pip call it; "" for none."""

    @abstractmethod
    def __init__(self, run: Path, options: Mapping[str, Any], step: int):
        """Start tracking, or continue it after `step` steps of the run in the folder `run`.

        options: of its recipe, by dotted path.
        """

    @abstractmethod
    def log(self, values: Mapping[str, float], step: int) -> None:
        """Take the numbers of a step, by name."""

    def picture(self, name: str, picture: np.ndarray, step: int) -> None:
        """Take a uint8 (H, W, 3) picture; the default ignores it."""
        return

    def close(self) -> None:
        """Finish writing what was logged."""
        return


class Trackers:
    """The trackers of a recipe, opened when the run's folder exists; all on the main process.

    One that fails is logged, closed and left out from then on: training goes on without it.
    Raises ValueError for one that is not installed, MissingExtraError if its package is missing.
    """

    def __init__(self, names: Sequence[str]) -> None:
        offered = {entry.name: entry for entry in installed("qgs.trackers")}
        if unknown := sorted({*names} - offered.keys()):
            raise ValueError(
                f"training.trackers names {listed(unknown)}, and installed distributions offer "
                f"{listed(sorted(offered)) or 'no tracker'}: take it out, or {INSTALL_ALL}"
            )
        self._kinds: dict[str, type[Tracker]] = {
            name: load(offered[name], Tracker) for name in names
        }
        for name, kind in self._kinds.items():
            if kind.package and find_spec(kind.package) is None:
                raise MissingExtraError(
                    f"training.trackers names {name}, which needs the package {kind.package}: run "
                    f"`pip install {kind.package}`, or take {name} out of training.trackers"
                )
        self._open: dict[str, Tracker] = {}

    def open(self, run: Path, options: Mapping[str, Any], step: int = 0) -> None:
        """Track into the folder `run` from step `step` + 1 on; log the recipe's `options`."""
        for name, kind in self._kinds.items():
            try:
                self._open[name] = kind(run, options, step)
            except Exception as error:
                _warn(name, error)

    def close(self) -> None:
        """End tracking."""
        self.tell(lambda tracker: tracker.close())

    def tell(self, act: Callable[[Tracker], None]) -> None:
        """Call a method of each tracker."""
        for name, tracker in list(self._open.items()):
            # A service may be down, and a distribution may raise anything.
            try:
                act(tracker)
            except Exception as error:
                _warn(name, error)
                del self._open[name]
                with suppress(Exception):  # the first failure was reported
                    tracker.close()


def _warn(name: str, error: Exception) -> None:
    reason = f"{type(error).__name__}: {error}"
    _log.warning("the tracker %s fails and is left out from now on: %s", name, reason)


class TrainingProgress(Progress):
    """A bar with loss, PSNR and time left; a line now and then where no terminal is."""

    def __init__(self, console: Console) -> None:
        super().__init__(
            TextColumn("step {task.fields[step]}"),
            BarColumn(),
            TextColumn("{task.fields[line]}"),
            TimeRemainingColumn(),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )
        self._task = self.add_task("training", total=1.0, step=0, line="")
        self._next = 0.0

    def show(self, step: int, loss: float, psnr: float, used: float) -> None:
        """Show a step. used: part of the budget."""
        line = f"loss {loss:.4f}  {Psnr.column.heading} {Psnr.column.shown(psnr):>5}"
        self.update(self._task, completed=used, step=step, line=line)
        now = time.monotonic()
        if self.disable and now >= self._next:
            self._next = now + _LOG_SECONDS
            self.console.print(f"step {step}  {line}  budget {used:.1%}", highlight=False)
