"""Trackers for `training.trackers`: TensorBoard and Weights & Biases, through `accelerate`."""

import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from accelerate.tracking import TensorBoardTracker, WandBTracker

from qgs.files import write_text
from qgs.train.tracking import Tracker


class _OfAccelerate(Tracker):
    """Base class of trackers that pass values and images on to a tracker of `accelerate`."""

    _tracker: Any
    _of_pictures: ClassVar[Mapping[str, str]] = {}

    def _start(self, options: Mapping[str, Any]) -> None:
        # Both take plain values only; lists and nulls become text.
        plain = {
            name: value if isinstance(value, bool | int | float | str) else str(value)
            for name, value in options.items()
        }
        self._tracker.start()
        self._tracker.store_init_configuration(plain)

    def log(self, values: Mapping[str, float], step: int) -> None:
        self._tracker.log(dict(values), step=step)

    def picture(self, name: str, picture: np.ndarray, step: int) -> None:
        self._tracker.log_images({name: picture[None]}, step=step, **self._of_pictures)

    def close(self) -> None:
        self._tracker.finish()


class TensorBoard(_OfAccelerate):
    """TensorBoard tracker, which writes to `tensorboard/` in the run folder."""

    package = "tensorboard"
    _of_pictures: ClassVar = {"dataformats": "NHWC"}

    def __init__(self, run: Path, options: Mapping[str, Any], step: int):
        # A resumed run repeats the steps after its last save; TensorBoard drops the old ones.
        self._tracker = TensorBoardTracker(self.package, run, purge_step=step + 1)
        self._start(options)


class WeightsAndBiases(_OfAccelerate):
    """Weights & Biases tracker, which writes to `wandb/` in the run folder.

    A resumed training continues its earlier run of Weights & Biases.
    """

    package = "wandb"

    def __init__(self, run: Path, options: Mapping[str, Any], step: int):
        place = run / "wandb" / "id"
        if not place.is_file():
            write_text(place, uuid.uuid4().hex)
        name = run.resolve().name
        known = place.read_text()
        self._tracker = WandBTracker("qgs", name=name, dir=str(run), id=known, resume="allow")
        self._start(options)
