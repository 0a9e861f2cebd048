"""Experiment trackers, and the progress of a training on the terminal.

A distribution adds a tracker by an entry point in the group `qgs.trackers` that names a `Tracker`.
"""

import logging
import time
import uuid
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from datetime import timedelta
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ClassVar, TypeAlias

import numpy as np
from accelerate.tracking import TensorBoardTracker, WandBTracker
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from qgs.contracts import MissingExtraError
from qgs.extensions import installed, load
from qgs.files import write_text
from qgs.metrics.images import Psnr
from qgs.wording import listed

Options: TypeAlias = Mapping[str, bool | int | float | str]

_REFRESH_SECONDS = 0.25
_LOG_SECONDS = 15.0

_log = logging.getLogger(__name__)


class Tracker(ABC):
    """A destination of the numbers and pictures of one run, in addition to its folder."""

    package: ClassVar[str] = ""
    """The package that it needs, an extra of query-gaussians."""

    @abstractmethod
    def __init__(self, run: Path, options: Options, step: int):
        """Start, or go on after `step` steps. run: the run's folder; options: of its recipe."""

    @abstractmethod
    def log(self, values: Mapping[str, float], step: int) -> None:
        """Take the numbers of a step, by name."""

    def picture(self, name: str, picture: np.ndarray, step: int) -> None:
        """Take a uint8 (H, W, 3) picture; the default ignores it."""
        return

    def close(self) -> None:
        """Bring what was logged to its place."""
        return


class _OfAccelerate(Tracker):
    """A tracker that accelerate has; subclasses make it in `_tracker`."""

    _tracker: Any
    _of_pictures: ClassVar[Mapping[str, str]] = {}

    def _start(self, options: Options) -> None:
        self._tracker.start()
        self._tracker.store_init_configuration(dict(options))

    def log(self, values: Mapping[str, float], step: int) -> None:
        self._tracker.log(dict(values), step=step)

    def picture(self, name: str, picture: np.ndarray, step: int) -> None:
        self._tracker.log_images({name: picture[None]}, step=step, **self._of_pictures)

    def close(self) -> None:
        self._tracker.finish()


class TensorBoard(_OfAccelerate):
    """Writes into RUN/tensorboard."""

    package = "tensorboard"
    _of_pictures: ClassVar = {"dataformats": "NHWC"}

    def __init__(self, run: Path, options: Options, step: int):
        # A resumed run repeats steps after its last save: TensorBoard drops those it has.
        self._tracker = TensorBoardTracker(self.package, run, purge_step=step + 1)
        self._start(options)


class WeightsAndBiases(_OfAccelerate):
    """Writes into RUN/wandb; a resumed training goes on in the same wandb run."""

    package = "wandb"

    def __init__(self, run: Path, options: Options, step: int):
        place = run / "wandb" / "id"
        if not place.is_file():
            write_text(place, uuid.uuid4().hex)
        name = run.resolve().name
        known = place.read_text()
        self._tracker = WandBTracker("qgs", name=name, dir=str(run), id=known, resume="allow")
        self._start(options)


def tracker_kind(name: str) -> type[Tracker]:
    """Return the tracker that `training.trackers` calls `name`.

    Raises ValueError for one that is not installed, MissingExtraError if its package is missing.
    """
    built_in: dict[str, type[Tracker]] = {"tensorboard": TensorBoard, "wandb": WeightsAndBiases}
    offered = {entry.name: entry for entry in installed("qgs.trackers")}
    if name not in {*built_in, *offered}:
        raise ValueError(
            f"training.trackers names {name!r}, which no installed distribution offers; there are "
            f"{listed(sorted({*built_in, *offered}))}"
        )
    kind = built_in.get(name) or load(offered[name], Tracker)
    if kind.package and find_spec(kind.package) is None:
        raise MissingExtraError(
            f"training.trackers names {name}, which is not installed: run "
            f'`pip install "query-gaussians[{name}]"`, or take it out of training.trackers'
        )
    return kind


class Trackers:
    """The trackers of a recipe, opened when the run's folder exists; all on the main process.

    One that fails is logged, closed and left out from then on: training goes on without it.
    Raises as `tracker_kind`.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._kinds = {name: tracker_kind(name) for name in names}
        self._open: dict[str, Tracker] = {}

    def open(self, run: Path, options: Mapping[str, Any], step: int = 0) -> None:
        """Track into the folder `run` from step `step` + 1 on; log the recipe's `options`."""
        # Trackers take plain values only; lists and nulls become text.
        plain = {
            name: value if isinstance(value, bool | int | float | str) else str(value)
            for name, value in options.items()
        }
        for name, kind in self._kinds.items():
            try:
                self._open[name] = kind(run, plain, step)
            except Exception as error:
                _warn(name, error)

    def close(self) -> None:
        """End tracking."""
        self.tell(lambda tracker: tracker.close())
        self._open.clear()

    def tell(self, act: Callable[[Tracker], None]) -> None:
        """Have each tracker take something."""
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
            auto_refresh=False,
            transient=True,
            speed_estimate_period=300,
            disable=not console.is_terminal,
        )
        self._task = self.add_task("training", total=1.0, step=0, line="")
        self._next = 0.0

    def show(self, step: int, loss: float, psnr: float, used: float) -> None:
        """Show a step, unless the last one was shown a moment ago. used: part of the budget."""
        now = time.monotonic()
        if now < self._next:
            return
        self._next = now + (_LOG_SECONDS if self.disable else _REFRESH_SECONDS)
        line = f"loss {loss:.4f}  {Psnr.column.heading} {Psnr.column.shown(psnr):>5}"
        self.update(self._task, completed=used, step=step, line=line, refresh=not self.disable)
        if self.disable:
            if (left := self.tasks[0].time_remaining) is not None:
                line += f"  {timedelta(seconds=round(left))} left"
            self.console.print(f"step {step}  {line}", highlight=False)
