"""Runs of tiny models, for the tests of training."""

import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import pytest
import torch
from rich.console import Console

from qgs.composer import Recipe, resolve
from qgs.data.samples import Batch
from qgs.data.stream import SampleStream, training_batches
from qgs.engine.distributed import StopRequest
from qgs.engine.folder import RunFolder
from qgs.engine.tracking import TrainingProgress
from qgs.engine.training import Trainer, TrainingResult, train

RECIPES = Path(__file__).parents[1] / "recipes" / "tiny"

SMALL = (
    "model.width=32",
    "model.heads=2",
    "model.queries.count=24",
    "model.head.gaussians_per_query=4",
    "data.image_size=[16, 16]",
    "views.targets=2",
    "evaluation.scenes=2",
    "training.steps=4",
    "training.seconds=null",
    "optimizer.warmup=2",
)
QUIET = Console(quiet=True)
Tiny: TypeAlias = Callable[..., Recipe]
"""The fixture `tiny`."""
TWO = ("plugins=[rooms, locus, two]", "objective={type: two/two_passes}", "views.inputs=5")
"""With the fixture `two`: train on two passes of the model."""


def tiny_recipe(name: str, *overrides: str) -> Recipe:
    """A recipe of recipes/tiny, smaller yet, with overrides."""
    return resolve(RECIPES / f"{name}.yaml", [*SMALL, *overrides])


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


def first_batch(recipe: Recipe) -> Batch:
    return next(training_batches(recipe.build_data(), recipe.views, 2, seed=0))


def losses(run: Path) -> list[float]:
    return [record["loss"] for record in RunFolder(run).history()]


def read_jsonl(path: Path) -> list[dict[str, Any]]:
    """The records of a JSONL file, each strictly JSON."""

    def refuse(constant: str) -> float:
        raise ValueError(f"{constant} is no JSON")

    text = path.read_text(encoding="utf-8").splitlines()
    return [json.loads(line, parse_constant=refuse) for line in text]


def change_batches(
    monkeypatch: pytest.MonkeyPatch, change: Callable[[Batch, Sequence[int]], None]
) -> None:
    """`change(batch, numbers of its samples)` alters each training batch in place."""
    whole = SampleStream.batch

    def changed(stream: SampleStream, numbers: Sequence[int]) -> Batch:
        batch = whole(stream, numbers)
        change(batch, numbers)
        return batch

    monkeypatch.setattr(SampleStream, "batch", changed)


def tensorboard_events(folder: Path) -> Any:
    """What TensorBoard reads of a run; the test is skipped without it."""
    name = "tensorboard.backend.event_processing.event_accumulator"
    module = pytest.importorskip(name, reason="the extra `tensorboard` is not installed")
    return module.EventAccumulator(str(folder / "tensorboard")).Reload()
