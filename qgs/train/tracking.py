"""Experiment trackers, and the progress bar of training.

A distribution adds a tracker, a subclass of `Tracker`, by an entry point in the group
`qgs.trackers`.
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
    """Base class of experiment trackers, which record numbers and pictures of a run."""

    package: ClassVar[str] = ""
    """Name, for both import and pip, of the package that the tracker needs; "" for no package."""

    @abstractmethod
    def __init__(self, run: Path, options: Mapping[str, Any], step: int):
        """Start to track the run in the folder `run`; if `step` is not 0, continue after that step.

        options: the recipe's options by dotted path.
        """

    @abstractmethod
    def log(self, values: Mapping[str, float], step: int) -> None:
        """Record the numbers of a step, by name."""

    def picture(self, name: str, picture: np.ndarray, step: int) -> None:
        """Record a uint8 (H, W, 3) picture; this base class does nothing."""
        return

    def close(self) -> None:
        """Finish writing everything that was logged."""
        return


class Trackers:
    """Trackers that a recipe names. Only the main process opens them, when the run's folder exists.

    A failure of a tracker is logged; the tracker is closed, and training continues without it.
    Raises ValueError for a tracker that is not installed, and MissingExtraError if a package that a
    tracker needs is missing.
    """

    def __init__(self, names: Sequence[str]) -> None:
        offered = installed("qgs.trackers")
        if unknown := sorted({*names} - offered.names):
            raise ValueError(
                f"training.trackers names {listed(unknown)}, but installed distributions offer "
                f"{listed(sorted(offered.names)) or 'no tracker'}: remove it, or {INSTALL_ALL}"
            )
        self._kinds: dict[str, type[Tracker]] = {
            name: load(offered[name], Tracker) for name in names
        }
        for name, kind in self._kinds.items():
            if kind.package and find_spec(kind.package) is None:
                raise MissingExtraError(
                    f"training.trackers names {name}, which needs the package {kind.package}: run "
                    f"`pip install {kind.package}`, or remove {name} from training.trackers"
                )
        self._open: dict[str, Tracker] = {}

    def open(self, run: Path, options: Mapping[str, Any], step: int) -> None:
        """Start all trackers for the run in the folder `run`.

        options: the recipe's options by dotted path. step: number of steps so far; 0 for a new run.
        """
        for name, kind in self._kinds.items():
            try:
                self._open[name] = kind(run, options, step)
            except Exception as error:
                _warn(name, error)

    def close(self) -> None:
        """Close all trackers."""
        self.tell(lambda tracker: tracker.close())

    def tell(self, act: Callable[[Tracker], None]) -> None:
        """Call `act` with each open tracker."""
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
    _log.warning("the tracker %s failed and is no longer used: %s", name, reason)


class TrainingProgress(Progress):
    """Progress bar with loss, PSNR and time left; outside a terminal, a line now and then."""

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
        """Show the numbers of a step. used: fraction of the training budget used so far."""
        line = f"loss {loss:.4f}  {Psnr.column.heading} {Psnr.column.shown(psnr):>5}"
        self.update(self._task, completed=used, step=step, line=line)
        now = time.monotonic()
        if self.disable and now >= self._next:
            self._next = now + _LOG_SECONDS
            self.console.print(f"step {step}  {line}  budget {used:.1%}", highlight=False)
