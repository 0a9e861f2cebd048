"""Folder of a training run: its files, and how the run is saved and continued."""

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from accelerate import PartialState
from accelerate.utils import wait_for_everyone
from filelock import FileLock, Timeout

from qgs.checkpoint.model_file import load_weights, save, unique_tensors
from qgs.checkpoint.models import CHECKPOINT
from qgs.checkpoint.tensors import (
    RECIPE,
    CheckpointError,
    TensorFile,
    Weights,
    copied,
    write_tensors,
)
from qgs.containers import map_tensors, named_tensors
from qgs.domain import KEY
from qgs.files import is_leftover, naming_full_disk, read_records, write_text
from qgs.machine import is_out_of_memory
from qgs.model import QueryGaussianModel
from qgs.recipe import Recipe, resolve
from qgs.recipe.recipe import differing_options

State = Mapping[str, Any]
"""Tensors, JSON values, and nested mappings of such values, by name."""
States = Mapping[str, State]
"""States by the name of the object that restores its own."""

HISTORY = "history.jsonl"
EVALUATIONS = "evaluations.jsonl"
_STATES = "qgs.state"
_LOCK = ".lock"
# Stands in JSON for a tensor, which the file holds by its dotted name.
_TENSOR = "tensor"

FREE = (
    "training.steps",
    "training.seconds",
    "training.accumulate",
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

They decide how long to train, where the data is and what is reported. They do not change what the
model learns. If the budget changes, the learning rate follows the new budget from then on. The list
`plugins` may change, because the types of components, PLUGIN/NAME, are compared. Two options that
are not listed here are not compared either: `training.accumulate`, which may change, and
`training.batch_size`, which `Counters` checks.
"""


class OtherRunError(ValueError):
    """Error for a run that cannot be continued with the given recipe, processes or data."""


class RunFolder:
    """Paths of the files of a run; the files need not exist yet.

    checkpoint: latest good weights. checkpoint_ema: moving average of the weights, if the recipe
    asks for one. state: everything needed to continue the run. evaluation: output of `qgs eval`.
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
        """True if the folder does not exist or holds only leftovers of killed processes."""
        if not self.path.is_dir():
            return True
        return all(is_leftover(file) or file.name == _LOCK for file in self.path.iterdir())

    def refuse_other(self, resume: bool) -> None:
        """Raise FileExistsError unless the folder is new or, with `resume`, holds a run."""
        if self.path.is_file():
            raise FileExistsError(f"{self.path} is a file; choose another folder for this run")
        if self.is_new or (resume and self.state.is_file()):
            return
        if not resume:
            raise FileExistsError(
                f"{self.path} is not empty, and a run never overwrites another one; choose another "
                "folder, delete this one, or continue its run with --resume"
            )
        # A run that was killed before its first save has only a recipe, and starts again.
        if self.checkpoint.exists() or not self.recipe.is_file():
            raise FileExistsError(
                f"{self.path} is not empty and holds no run that can be continued: "
                f"{self.state.name} is missing; choose another folder"
            )

    def take(self) -> None:
        """Lock the folder for this process until `close`.

        Deletes temporary files of killed processes. Raises FileExistsError while another process
        trains in the folder.
        """
        self.path.mkdir(parents=True, exist_ok=True)
        try:
            # The operating system releases the lock of a dead process.
            self._lock.acquire()
        except Timeout:
            raise FileExistsError(
                f"another process is training in {self.path}; wait until it ends, or choose "
                "another folder"
            ) from None
        for leftover in filter(is_leftover, self.path.iterdir()):
            leftover.unlink()

    def append(self, *records: Mapping[str, Any], name: str = HISTORY) -> None:
        """Append one line per record to the file `name`; on failure no line is added."""
        path = self.path / name
        # Opened for each call: readers see every step, and a kill loses no buffered lines.
        with naming_full_disk(path), path.open("a", encoding="utf-8") as file:
            file.write("".join(json.dumps(record) + "\n" for record in records))

    def history(self) -> list[dict[str, float]]:
        """Return one record per optimiser step so far, without values that are not finite."""
        return read_records(self.history_file)

    def cut_records(self, step: int) -> None:
        """Drop records of steps after `step`, and damaged lines, from the histories of the run."""
        for path in (self.history_file, self.path / EVALUATIONS):
            if path.exists():
                kept = [record for record in read_records(path) if record["step"] <= step]
                write_text(path, "".join(json.dumps(record) + "\n" for record in kept))

    def close(self) -> None:
        """Unlock the folder."""
        if self._lock.is_locked:
            # Deleted while the lock is held: the next process creates its own lock file.
            Path(self._lock.lock_file).unlink(missing_ok=True)
            self._lock.release(force=True)


@dataclass
class Saver:
    """Writer of the checkpoint and the state of a run; only the main process writes.

    stateful: objects to save and restore besides the weights, by name. Each has `state()`, which
    returns a State, and `load_state(state)`, which restores it. The state of the entry "ema" is
    saved as a checkpoint too.
    Each file is written completely or not at all. All processes must call each method together.
    """

    folder: RunFolder
    model: QueryGaussianModel
    stateful: dict[str, Any] = field(default_factory=dict)

    def save(self, step: int, good: tuple[int, Weights] | None = None) -> None:
        """Save the run after `step` optimiser steps.

        good: number of steps and weights to save as the checkpoint in place of the present weights.
            The checkpoint of the moving average is then not written. None saves the present
            weights.
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
            # Written last: the state is complete by itself, and must not be ahead of the weights.
            self._write_state(states)
        wait_for_everyone()

    def save_checkpoint(self, step: int, weights: Weights) -> None:
        """Save `weights`, reached after `step` steps, as the checkpoint of the run."""
        if PartialState().is_main_process:
            self._write_checkpoint(self.folder.checkpoint, step, weights)
        wait_for_everyone()

    def restore(self, states: States) -> None:
        """Restore the weights and every entry of `stateful` from `states`.

        Raises CheckpointError if `states` does not fit this run.
        """
        load_weights(self.model, states.get("weights", {}), self.folder.state)
        for name, one in self.stateful.items():
            try:
                one.load_state(states[name])
            except Exception as error:  # a plugin's component may raise anything
                if isinstance(error, OtherRunError) or is_out_of_memory(error):
                    raise
                raise CheckpointError(
                    f"{self.folder.state} is damaged or was written by another version of qgs: its "
                    f"part `{name}` cannot be restored ({type(error).__name__}: {error}); "
                    "start a new run in another folder"
                ) from error

    def _write_checkpoint(self, path: Path, step: int, weights: Weights) -> None:
        extra = {"step": str(step), KEY: self.model.trained_on.text}
        save(self.model, path, extra=extra, weights=weights)

    def _write_state(self, states: States) -> None:
        # The history must reach the disk first: a state ahead of it would leave a gap.
        history = self.folder.history_file
        with naming_full_disk(history), history.open("a") as file:
            os.fsync(file.fileno())
        write_state(self.folder.state, self.model.recipe or {}, states)


def write_state(path: Path, recipe: Mapping[str, Any], states: States) -> None:
    """Write `states` to `path`, completely or not at all. recipe: complete recipe of the run."""
    # safetensors refuses views and tensors that share memory.
    tensors = copied(dict(named_tensors(states)))
    values = map_tensors(lambda _: _TENSOR, states)
    write_tensors(path, tensors, {_STATES: json.dumps(values), RECIPE: json.dumps(recipe)})


def read_state(path: Path) -> tuple[Recipe, States]:
    """Read a file that `write_state` wrote; return its recipe and states.

    Raises FileNotFoundError, CheckpointError for a damaged file, and RecipeError for a bad recipe.
    """
    with TensorFile(path) as file:
        tensors = file.read()

        def filled(value: Any, place: str) -> Any:
            if isinstance(value, dict):
                return {key: filled(item, f"{place}.{key}") for key, item in value.items()}
            return tensors[place] if value == _TENSOR else value

        with file.entry(_STATES) as text:
            states = {name: filled(state, name) for name, state in json.loads(text).items()}
        return file.stored_recipe(), states


def saved_state(folder: RunFolder, recipe: Recipe) -> States:
    """Return the saved states of the run in `folder`; empty if the run starts at step 0.

    A run that was stopped before its first save starts at step 0. Raises OtherRunError if `recipe`
    and the run's recipe differ in options that are not in FREE, and CheckpointError if the state
    cannot be read.
    """
    if folder.state.is_file():
        run, states = read_state(folder.state)
    else:
        # A run that was killed before its first save has only a recipe, and starts again.
        run = resolve(folder.recipe)
        states = {}
    may_change = tuple(f"{key}." for key in FREE)
    differing = [
        f"\n  {key}: {ours or 'absent'} here, {theirs or 'absent'} in the run"
        for key, (ours, theirs) in differing_options(recipe.tree, run.tree).items()
        if not f"{key}.".startswith(may_change)
    ]
    if differing:
        raise OtherRunError(
            f"{folder.path} holds a run of another recipe, which this recipe cannot "
            f"continue:{''.join(line[:500] for line in differing)}"
            f"\nContinue it with its own recipe, {folder.recipe}, or choose another folder. "
            f"Only these may change: {', '.join(FREE)}."
        )
    return states
