"""Progress of a training on the terminal, and logging to experiment trackers."""

import time
import uuid
from collections.abc import Mapping, Sequence
from datetime import timedelta
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from accelerate.tracking import GeneralTracker, TensorBoardTracker, WandBTracker
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from qgs.composer import Recipe
from qgs.composer.recipe import flat
from qgs.contracts import MissingExtraError
from qgs.io.files import write_text
from qgs.metrics.images import Psnr

_REFRESH_SECONDS = 0.25
_LOG_SECONDS = 15.0


class Trackers:
    """The trackers of a recipe, opened when the run's folder exists; all on the main process.

    TensorBoard writes into RUN/tensorboard, wandb into RUN/wandb; its run goes on when training is
    resumed. Raises MissingExtraError for a tracker whose package is not installed.
    """

    def __init__(self, names: Sequence[str]) -> None:
        for name in names:
            if find_spec(name) is None:
                raise MissingExtraError(
                    f"training.trackers names {name}, which is not installed: run "
                    f'`pip install "query-gaussians[{name}]"`, or take it out of training.trackers'
                )
        self._names = names
        self._open: list[GeneralTracker] = []

    def open(self, run: Path, recipe: Recipe, step: int = 0) -> None:
        """Track into the folder `run` from step `step` + 1 on; log the options of `recipe`."""
        options = flat(recipe.tree).items()
        plain = {k: v if isinstance(v, bool | int | float | str) else str(v) for k, v in options}
        for name in self._names:
            if name == "tensorboard":
                tracker = TensorBoardTracker(name, logging_dir=run, purge_step=step + 1)
            else:
                place = run / "wandb" / "id"
                if not place.is_file():
                    write_text(place, uuid.uuid4().hex)
                own = {"name": run.resolve().name, "dir": str(run), "id": place.read_text()}
                tracker = WandBTracker("qgs", **own, resume="allow")
            tracker.start()
            tracker.store_init_configuration(plain)
            self._open.append(tracker)

    def log(self, values: Mapping[str, float], step: int) -> None:
        """Numbers of a step, by name."""
        for tracker in self._open:
            tracker.log(dict(values), step=step)

    def picture(self, name: str, picture: np.ndarray, step: int) -> None:
        """A uint8 (H, W, 3) picture."""
        for tracker in self._open:
            if isinstance(tracker, TensorBoardTracker):
                tracker.log_images({name: picture[None]}, step=step, dataformats="NHWC")
            elif isinstance(tracker, WandBTracker):
                tracker.log_images({name: [picture]}, step=step)

    def close(self) -> None:
        """End tracking; what was logged is on the disk then."""
        for tracker in self._open:
            tracker.finish()
        self._open = []


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
