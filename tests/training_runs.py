"""Runs of tiny models, for the tests of training."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import torch
from rich.console import Console

from qgs.composer import Recipe
from qgs.engine import RunFolder, TrainingResult, train
from qgs.engine.distributed import StopRequest
from qgs.engine.tracking import TrainingProgress
from qgs.engine.training import Trainer

QUIET = Console(quiet=True)
Tiny: TypeAlias = Callable[..., Recipe]
"""The fixture `tiny`."""


def run(recipe: Recipe, folder: Path, resume: bool = False, device: str = "cpu") -> TrainingResult:
    return train(recipe, folder, console=QUIET, device=device, resume=resume)


run_anywhere = partial(run, device="auto")


def run_calling(
    after_step: Callable[[Trainer, StopRequest], Any],
    recipe: Recipe,
    folder: Path,
    resume: bool = False,
) -> TrainingResult:
    """A run that calls `after_step(trainer, stop)` after each step."""
    stop = StopRequest()

    class Calling(TrainingProgress):
        def update(self, *_: float) -> bool:
            after_step(trainer, stop)
            return False

    with closing(Trainer(recipe, folder, resume=resume)) as trainer:
        return trainer.run(Calling(QUIET), stop)


def weights(result: TrainingResult) -> dict[str, torch.Tensor]:
    return result.model.state_dict()


def same(first: Mapping[str, torch.Tensor], second: Mapping[str, torch.Tensor]) -> bool:
    return first.keys() == second.keys() and all(
        torch.equal(t, second[n]) for n, t in first.items()
    )


def losses(run: Path) -> list[float]:
    return [record["loss"] for record in RunFolder(run).history()]
