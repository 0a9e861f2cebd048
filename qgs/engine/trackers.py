"""Where metrics and pictures go besides the run's own files, through accelerate's trackers."""

from __future__ import annotations

import uuid
from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from accelerate.tracking import GeneralTracker, TensorBoardTracker, WandBTracker

from qgs.composer import Recipe
from qgs.composer.show import flat
from qgs.contracts.extras import MissingExtraError
from qgs.io.atomic import write_text

_PLAIN = (bool, int, float, str)


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
                    f"`pip install qgs[{name}]`, or take it out of training.trackers"
                )
        self._names = names
        self._open: list[GeneralTracker] = []

    def open(self, run: Path, recipe: Recipe, step: int = 0) -> None:
        """Track into the folder `run` from step `step` + 1 on; tell the options of `recipe`."""
        self._open = [_OPENERS[name](run, step) for name in self._names]
        values = {k: v if isinstance(v, _PLAIN) else str(v) for k, v in flat(recipe.tree).items()}
        for tracker in self._open:
            tracker.store_init_configuration(values)

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
        """End tracking; what was told is on the disk then."""
        for tracker in self._open:
            tracker.finish()
        self._open = []


def _tensorboard(run: Path, step: int) -> GeneralTracker:
    tracker = TensorBoardTracker("tensorboard", logging_dir=run, purge_step=step + 1)
    tracker.start()
    return tracker


def _wandb(run: Path, step: int) -> GeneralTracker:
    place = run / "wandb" / "id"
    if not place.is_file():
        write_text(place, uuid.uuid4().hex)
    tracker = WandBTracker(
        "qgs", name=run.resolve().name, dir=str(run), id=place.read_text(), resume="allow"
    )
    tracker.start()
    return tracker


_OPENERS: Mapping[str, Callable[[Path, int], Any]] = {"tensorboard": _tensorboard, "wandb": _wandb}
