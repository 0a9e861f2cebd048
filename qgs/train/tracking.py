"""Experiment trackers, and the progress of a training on the terminal.

A distribution adds a tracker by an entry point in the group `qgs.trackers` that names a `Tracker`.
"""

import logging
import time
import uuid
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from datetime import timedelta
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from accelerate.tracking import TensorBoardTracker, WandBTracker
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from qgs.contracts import MissingExtraError
from qgs.extensions import installed, load
from qgs.files import write_text
from qgs.metrics.images import Psnr
from qgs.recipe import Recipe
from qgs.recipe.recipe import flat
from qgs.wording import listed

GROUP = "qgs.trackers"

_REFRESH_SECONDS = 0.25
_LOG_SECONDS = 15.0

_log = logging.getLogger(__name__)


class Tracker(ABC):
    """Where the numbers and pictures of one run go in addition to its folder."""

    package: ClassVar[str] = ""
    """The package that it needs, an extra of query-gaussians."""

    @abstractmethod
    def __init__(self, run: Path, options: Mapping[str, bool | int | float | str], step: int):
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
    """A tracker that accelerate has."""

    def _start(self, tracker: Any, options: Mapping[str, bool | int | float | str]) -> None:
        self._tracker = tracker
        tracker.start()
        tracker.store_init_configuration(dict(options))

    def log(self, values: Mapping[str, float], step: int) -> None:
        self._tracker.log(dict(values), step=step)

    def close(self) -> None:
        self._tracker.finish()


class TensorBoard(_OfAccelerate):
    """Writes into RUN/tensorboard."""

    package = "tensorboard"

    def __init__(self, run: Path, options: Mapping[str, bool | int | float | str], step: int):
        # A resumed run repeats steps after its last save: TensorBoard drops those it has.
        self._start(TensorBoardTracker(self.package, run, purge_step=step + 1), options)

    def picture(self, name: str, picture: np.ndarray, step: int) -> None:
        self._tracker.log_images({name: picture[None]}, step=step, dataformats="NHWC")


class WeightsAndBiases(_OfAccelerate):
    """Writes into RUN/wandb; a resumed training goes on in the same wandb run."""

    package = "wandb"

    def __init__(self, run: Path, options: Mapping[str, bool | int | float | str], step: int):
        place = run / "wandb" / "id"
        if not place.is_file():
            write_text(place, uuid.uuid4().hex)
        own = {"name": run.resolve().name, "dir": str(run), "id": place.read_text()}
        self._start(WandBTracker("qgs", **own, resume="allow"), options)

    def picture(self, name: str, picture: np.ndarray, step: int) -> None:
        self._tracker.log_images({name: [picture]}, step=step)


def tracker_kind(name: str) -> type[Tracker]:
    """The tracker that `training.trackers` calls `name`.

    Raises ValueError for one that is not installed, MissingExtraError if its package is missing.
    """
    kinds: dict[str, type[Tracker]] = {"tensorboard": TensorBoard, "wandb": WeightsAndBiases}
    offered = {entry.name: entry for entry in installed(GROUP)}
    if name not in {*kinds, *offered}:
        raise ValueError(
            f"training.trackers names {name!r}, which no installed distribution offers; there are "
            f"{listed(sorted({*kinds, *offered}))}"
        )
    kind = kinds.get(name) or load(offered[name], Tracker)
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

    def open(self, run: Path, recipe: Recipe, step: int = 0) -> None:
        """Track into the folder `run` from step `step` + 1 on; log the options of `recipe`."""
        # Trackers take plain values only; lists and nulls become text.
        options = flat(recipe.tree).items()
        plain = {k: v if isinstance(v, bool | int | float | str) else str(v) for k, v in options}
        for name, kind in self._kinds.items():
            with self._left_out_if_it_fails(name):
                self._open[name] = kind(run, plain, step)

    def log(self, values: Mapping[str, float], step: int) -> None:
        """Numbers of a step, by name."""
        for name, tracker in [*self._open.items()]:
            with self._left_out_if_it_fails(name):
                tracker.log(values, step)

    def picture(self, name: str, picture: np.ndarray, step: int) -> None:
        """A uint8 (H, W, 3) picture."""
        for kind, tracker in [*self._open.items()]:
            with self._left_out_if_it_fails(kind):
                tracker.picture(name, picture, step)

    def close(self) -> None:
        """End tracking."""
        for name in [*self._open]:
            with self._left_out_if_it_fails(name):
                self._open.pop(name).close()

    @contextmanager
    def _left_out_if_it_fails(self, name: str) -> Iterator[None]:
        try:
            yield
        except Exception as error:  # a service that is down, or whatever a distribution raises
            reason = f"{type(error).__name__}: {error}"
            _log.warning("the tracker %s fails and is left out from now on: %s", name, reason)
            if failed := self._open.pop(name, None):
                with suppress(Exception):  # it was reported
                    failed.close()


class TrainingProgress:
    """A bar with loss, PSNR, images/s and time left; a line now and then where no terminal is."""

    def __init__(self, console: Console) -> None:
        self._console = console
        columns = (
            TextColumn("step {task.fields[step]}"),
            BarColumn(),
            TextColumn("{task.fields[line]}"),
        )
        self._bar = Progress(*columns, console=console, auto_refresh=False, transient=True)
        self._task = self._bar.add_task("training", total=1.0, step=0, line="")
        self._next = 0.0
        self._start: tuple[int, float, float] | None = None
        self._interval = _REFRESH_SECONDS if console.is_terminal else _LOG_SECONDS

    def __enter__(self) -> "TrainingProgress":
        if self._console.is_terminal:
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def update(
        self, step: int, loss: float, psnr: float, images: int, seconds: float, used: float
    ) -> bool:
        """Show a step, unless the last one was shown a moment ago; returns whether it did.

        images, seconds: of the whole run so far; what is shown is of this session. used: fraction
        of the budget.
        """
        # Speed is of this session: a resumed run may be on another machine.
        if self._start is None:
            self._start = images, seconds, used
        now = time.monotonic()
        if now < self._next:
            return False
        self._next = now + self._interval
        done, spent = images - self._start[0], seconds - self._start[1]
        gained = used - self._start[2]
        left = timedelta(seconds=round(max(spent * (1 - used) / gained, 0))) if gained else None
        quality = f"{Psnr.column.heading} {Psnr.column.shown(psnr):>5}"
        line = f"loss {loss:.4f}  {quality}"
        if done and spent:
            line += f"  {done / spent:.{0 if done > 10 * spent else 1}f} images/s"
        if left is not None:
            line += f"  {left} left"
        if self._console.is_terminal:
            self._bar.update(self._task, completed=used, step=step, line=line, refresh=True)
        else:
            self._console.print(f"step {step}  {line}", highlight=False)
        return True
