"""The folder of one training run: its files, what is saved in it, and how a run is continued."""

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import torch
from accelerate import PartialState
from accelerate.utils import wait_for_everyone
from filelock import FileLock, Timeout
from torch import Tensor

from qgs.checkpoint.model_file import load_weights, save, unique_tensors
from qgs.checkpoint.models import CHECKPOINT
from qgs.checkpoint.tensors import CheckpointError, TensorFile, write_tensors
from qgs.domain import KEY, Domain
from qgs.files import is_leftover, naming_full_disk, read_records, write_text
from qgs.machine import is_out_of_memory
from qgs.model import QueryGaussianModel
from qgs.recipe import Recipe, resolve
from qgs.recipe.recipe import differing_options

State: TypeAlias = Mapping[str, Any]
"""Tensors and JSON values by name."""

HISTORY = "history.jsonl"
EVALUATIONS = "evaluations.jsonl"
_STATES = "qgs.state"
_RECIPE = "qgs.recipe"
_LOCK = ".lock"

FREE = (
    "training.steps",
    "training.seconds",
    "training.save_every",
    "training.collapse_window",
    "training.workers",
    "training.render_views",
    "training.on_nonfinite",
    "training.on_bad_sample",
    "training.evaluate_every",
    "training.trackers",
    "evaluation",
    "metrics",
    "plugins",
    "data.path",
)
"""Parts of a recipe that may change when a run is continued.

They decide how long to train, where data lies and what is reported, not what is learnt. With
another budget the learning rate follows the new one from there. Plugins that the model uses are
compared by its types. `training.accumulate` may change too: a step sees the same samples.
"""


class OtherRunError(ValueError):
    """Error: a run cannot continue with this recipe, these processes or this data."""


class RunFolder:
    """Files of a run, existing or not.

    checkpoint: the latest good weights; checkpoint_ema: their moving average, where a recipe asks
    for it; state: everything that continues the run; evaluation: where `qgs eval` writes.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.recipe = self.path / "recipe.yaml"
        self.checkpoint = self.path / CHECKPOINT
        self.checkpoint_ema = self.path / "checkpoint_ema.safetensors"
        self.state = self.path / "state.safetensors"
        self.evaluation = self.path / "evaluation"
        self.history_file = self.path / HISTORY
        self._lock = FileLock(self.path / _LOCK, blocking=False)

    @property
    def is_new(self) -> bool:
        """True where the folder does not exist or holds only what killed processes left."""
        if not self.path.is_dir():
            return True
        return all(is_leftover(file) or file.name == _LOCK for file in self.path.iterdir())

    def refuse_other(self, resume: bool) -> None:
        """Raise FileExistsError unless the path is new or, with `resume`, holds a run."""
        if self.path.is_file():
            raise FileExistsError(f"{self.path} is a file; choose another folder for this run")
        if self.is_new or (resume and self.state.is_file()):
            return
        if not resume:
            raise FileExistsError(
                f"{self.path} is not empty and a run never overwrites another; choose another "
                "folder, delete it yourself, or continue its run with --resume"
            )
        # A run that was killed before its first save has a recipe alone, and starts again.
        if self.checkpoint.exists() or not self.recipe.is_file():
            raise FileExistsError(
                f"{self.path} is not empty and holds no run that can be continued: "
                f"{self.state.name} is missing; choose another folder"
            )

    def take(self) -> None:
        """Lock the folder for this process until `close`; delete temporary files of killed ones.

        Raises FileExistsError while another process trains in it.
        """
        self.path.mkdir(parents=True, exist_ok=True)
        try:
            # The system takes the lock off a dead process.
            self._lock.acquire()
        except Timeout:
            raise FileExistsError(
                f"another process is training in {self.path}; wait for its end, or choose "
                "another folder"
            ) from None
        for leftover in filter(is_leftover, self.path.iterdir()):
            leftover.unlink()

    def append(self, *records: Mapping[str, Any], name: str = HISTORY) -> None:
        """Add a line each to the history, or to another file of records: all of them or none."""
        path = self.path / name
        # Opened for each line: readers see every step, and a kill leaves nothing in a buffer.
        with naming_full_disk(path), path.open("a", encoding="utf-8") as file:
            file.write("".join(json.dumps(record) + "\n" for record in records))

    def history(self) -> list[dict[str, float]]:
        """Return all records so far, one per optimiser step."""
        return read_records(self.history_file)

    def cut_records(self, step: int) -> None:
        """Drop the records of later steps than `step`, and lines that are damaged."""
        for path in (self.history_file, self.path / EVALUATIONS):
            if path.exists():
                kept = [record for record in read_records(path) if record["step"] <= step]
                write_text(path, "".join(json.dumps(record) + "\n" for record in kept))

    def close(self) -> None:
        """Unlock the folder."""
        if self._lock.is_locked:
            # While it is held: whoever comes next makes a lock file of its own.
            Path(self._lock.lock_file).unlink(missing_ok=True)
            self._lock.release(force=True)


@dataclass
class Saver:
    """Writer of the checkpoint and the state of a run; only the main process writes.

    stateful: what continues the run, beside the weights, by name. Each has `state()`, which returns
    a State, and `load_state(state)`, which restores it. "ema" has a checkpoint too.
    Each file appears whole or not at all. All processes must call each method together.
    """

    folder: RunFolder
    model: QueryGaussianModel
    stateful: dict[str, Any] = field(default_factory=dict)

    def save(self, step: int, good: tuple[int, Mapping[str, Tensor]] | None = None) -> None:
        """Save the run after `step` optimiser steps.

        good: steps and weights of the checkpoint, if not the present ones; averages then stay.
        """
        states: dict[str, State] = {"weights": unique_tensors(self.model)}
        states |= {name: one.state() for name, one in self.stateful.items()}
        if PartialState().is_main_process:
            # A kill between the files must not leave a checkpoint that cannot go on.
            if not self.folder.state.exists():
                self._write_state(states)
            saved, weights = good or (step, states["weights"])
            self._write_checkpoint(self.folder.checkpoint, saved, weights)
            if "ema" in states and not good:
                self._write_checkpoint(self.folder.checkpoint_ema, step, states["ema"])
            # Last: complete by itself, and never ahead of the weights.
            self._write_state(states)
        wait_for_everyone()

    def save_checkpoint(self, step: int, weights: Mapping[str, Tensor]) -> None:
        """Save a checkpoint of other weights than the present ones."""
        if PartialState().is_main_process:
            self._write_checkpoint(self.folder.checkpoint, step, weights)
        wait_for_everyone()

    def restore(self, states: Mapping[str, State]) -> None:
        """Restore the weights and all stateful parts; raises CheckpointError."""
        load_weights(self.model, states.get("weights", {}), self.folder.state)
        for name, one in self.stateful.items():
            try:
                one.load_state(states[name])
            except Exception as error:  # a component of a plugin may raise anything
                if isinstance(error, OtherRunError) or is_out_of_memory(error):
                    raise
                raise CheckpointError(
                    f"{self.folder.state} is damaged, or another version of qgs wrote it: its part "
                    f"`{name}` cannot be restored ({type(error).__name__}: {error})"
                ) from error

    def _write_checkpoint(self, path: Path, step: int, weights: Mapping[str, Tensor]) -> None:
        domain = self.model.trained_on or Domain()
        save(self.model, path, extra={"step": str(step), KEY: domain.text}, weights=weights)

    def _write_state(self, states: Mapping[str, State]) -> None:
        # The history must reach the disk first: a state ahead of it would leave a gap.
        history = self.folder.history_file
        with naming_full_disk(history), history.open("a") as file:
            os.fsync(file.fileno())
        write_state(self.folder.state, self.model.recipe or {}, states)


def write_state(path: Path, recipe: Mapping[str, Any], states: Mapping[str, State]) -> None:
    """Write `states` to `path`, whole or not at all; recipe: the resolved tree."""
    tensors: dict[str, Tensor] = {}
    values: dict[str, dict[str, Any]] = {}
    for name, state in states.items():
        values[name] = {}
        for key, value in state.items():
            if isinstance(value, Tensor):
                # safetensors refuses views and tensors that share memory.
                own = value.detach().cpu().clone(memory_format=torch.contiguous_format)
                tensors[f"{name}/{key}"] = own
            else:
                values[name][key] = value
    write_tensors(path, tensors, {_STATES: json.dumps(values), _RECIPE: json.dumps(recipe)})


def read_state(path: Path) -> tuple[Recipe, Mapping[str, State]]:
    """Read what `write_state` wrote; raises FileNotFoundError, CheckpointError, RecipeError."""
    with TensorFile(path) as file:
        states = file.mapping(_STATES)
        for place, tensor in file.read().items():
            name, _, key = place.partition("/")
            states.setdefault(name, {})[key] = tensor
        return file.stored_recipe(_RECIPE), states


def saved_state(folder: RunFolder, recipe: Recipe) -> Mapping[str, State]:
    """Return the states from which the run in `folder` continues; none to start it from step 0.

    Raises OtherRunError unless `recipe` equals the run's outside of FREE, CheckpointError when the
    state cannot be read.
    """
    if folder.state.is_file():
        run, states = read_state(folder.state)
    else:
        # A run that was killed before its first save has a recipe alone: it starts again.
        run = resolve(folder.recipe)
        states = {}
    # `Counters` compares the scenes of a step, which older runs counted by process.
    may_change = tuple(f"{k}." for k in (*FREE, "training.batch_size", "training.accumulate"))
    differing = [
        f"\n  {key}: {ours or 'absent'} here, {theirs or 'absent'} in the run"
        for key, (ours, theirs) in differing_options(recipe.tree, run.tree).items()
        if not f"{key}.".startswith(may_change)
    ]
    if differing:
        raise OtherRunError(
            f"{folder.path} holds a run with another recipe, which cannot be continued with this "
            f"one:{''.join(line[:500] for line in differing)}"
            f"\nContinue it with its own recipe, {folder.recipe}, or choose another folder. "
            f"Only these may change: {', '.join(FREE)}."
        )
    return states
