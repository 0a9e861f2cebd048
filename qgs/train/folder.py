"""The folder of one training run: its files, what is saved in it, and how a run is continued."""

import fcntl
import json
import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, TextIO, TypeAlias

import torch
from accelerate import Accelerator
from torch import Tensor, nn

from qgs.checkpoint.model_file import load_weights, save, unique_tensors
from qgs.checkpoint.models import CHECKPOINT
from qgs.checkpoint.tensors import CheckpointError, TensorFile, write_tensors
from qgs.domain import KEY, Domain
from qgs.files import is_leftover, naming_full_disk, read_records, write_text
from qgs.machine import is_out_of_memory
from qgs.model import QueryGaussianModel
from qgs.recipe import Recipe, RecipeError, resolve
from qgs.recipe.recipe import flat
from qgs.wording import listed

State: TypeAlias = Mapping[str, Any]
"""Tensors and JSON values by name."""

_PARTS, _RECIPE = "qgs.state", "qgs.recipe"

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
    """A run cannot be continued with this recipe, these processes or this data."""


class RunFolder:
    """The files of a run, whether they exist yet or not.

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
        self._history_file = self.path / "history.jsonl"
        self._history: TextIO | None = None
        self._lock: int | None = None

    @property
    def is_new(self) -> bool:
        """Whether the folder does not exist or holds nothing but what killed processes left."""
        return not self.path.is_dir() or all(map(is_leftover, self.path.iterdir()))

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
        if self.checkpoint.exists():
            raise FileExistsError(
                f"{self.state} is missing or no file, so the run whose {self.checkpoint.name} is "
                "there cannot be continued, and starting again would overwrite it; choose another "
                "folder"
            )
        if not self.recipe.is_file():
            raise FileExistsError(
                f"{self.path} is not empty and holds no run of `qgs train`; choose another folder"
            )

    def take(self) -> None:
        """Lock the folder for this process until `close`; delete temporary files of killed ones.

        Raises FileExistsError while another process trains in it.
        """
        self.path.mkdir(parents=True, exist_ok=True)
        if self._lock is None:
            # The lock is on the folder itself, so no lock file can be left behind.
            self._lock = os.open(self.path, os.O_RDONLY)
            try:  # the system takes the lock off a dead process
                fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                self.close()
                raise FileExistsError(
                    f"another process is training in {self.path}; wait for its end, or choose "
                    "another folder"
                ) from None
            except OSError:
                self.close()  # this file system knows no locks
        for leftover in filter(is_leftover, self.path.iterdir()):
            leftover.unlink()

    def append(self, record: Mapping[str, float]) -> None:
        """Add one line to the history."""
        with naming_full_disk(self._history_file):
            if self._history is None:
                self._history = self._history_file.open("a", encoding="utf-8")
            # Buffered: a line a step is written, but flushed only for readers and saves.
            self._history.write(json.dumps(record) + "\n")

    def flush(self, to_disk: bool = False) -> None:
        """Let others read the history so far; to_disk: also see that it outlives the system."""
        if self._history is not None:
            with naming_full_disk(self._history_file):
                self._history.flush()
                if to_disk:
                    os.fsync(self._history.fileno())

    def history(self) -> list[dict[str, float]]:
        """All records so far, one per optimiser step; of one left out, finite numbers."""
        self.flush()
        return read_records(self._history_file)

    def cut_history(self, step: int) -> None:
        """Drop the records of later steps than `step`, and lines that are damaged."""
        if self._history_file.exists():
            kept = [record for record in self.history() if record["step"] <= step]
            write_text(self._history_file, "".join(json.dumps(record) + "\n" for record in kept))

    def close(self) -> None:
        """Close the history and leave the folder to others."""
        if self._history is not None:
            with suppress(OSError):  # a full disk: the last flush raised already
                self._history.close()
        if self._lock is not None:
            os.close(self._lock)
        self._history = self._lock = None


class Stateful(Protocol):
    """A part of a run that must be continued where it stopped."""

    def state(self) -> State:
        """Tensors and JSON values that continue this object; all processes must call it."""
        ...

    def load_state(self, state: State) -> None:
        """Restore from `state`."""
        ...


class Saver:
    """Writes the checkpoint and the state of a run; of several processes, the main one writes.

    parts: everything that continues the run, by name; checkpoints hold "weights" and "ema".
    domain: ranges of the training views, which checkpoints carry.
    Each file appears whole or not at all. All processes must call each method together.
    """

    def __init__(
        self,
        accelerator: Accelerator,
        folder: RunFolder,
        model: QueryGaussianModel,
        domain: Domain,
    ) -> None:
        self._accelerator, self.folder, self.model = accelerator, folder, model
        self.domain = domain
        self.parts: dict[str, Stateful] = {"weights": _Weights(model)}

    def save(self, step: int, state_only: bool = False) -> None:
        """Save the run after `step` optimiser steps; `state_only` leaves the checkpoints."""
        parts = {name: part.state() for name, part in self.parts.items()}
        if self._accelerator.is_main_process:
            if not state_only:
                if not self.folder.state.exists():
                    # A kill between the files must not leave a checkpoint that cannot go on.
                    self._write_state(parts)
                self._write_checkpoint(self.folder.checkpoint, step, parts["weights"])
                if "ema" in parts:
                    self._write_checkpoint(self.folder.checkpoint_ema, step, parts["ema"])
            self._write_state(parts)  # last: complete by itself, and never ahead of the weights
        self._accelerator.wait_for_everyone()

    def save_checkpoint(self, step: int, weights: Mapping[str, Tensor]) -> None:
        """Save a checkpoint of other weights than the present ones."""
        if self._accelerator.is_main_process:
            self._write_checkpoint(self.folder.checkpoint, step, weights)
        self._accelerator.wait_for_everyone()

    def restore(self, parts: Mapping[str, State]) -> None:
        """Bring every part back to its state in `parts`; raises CheckpointError."""
        missing = [name for name in self.parts if name not in parts]
        if missing:
            raise CheckpointError(
                f"{self.folder.state} lacks {listed(missing)}: another version of qgs wrote it; "
                "continue the run with that version"
            )
        for name, part in self.parts.items():
            try:
                part.load_state(parts[name])
            except OtherRunError:
                raise
            except Exception as error:  # a part of a plugin may raise anything
                if is_out_of_memory(error):
                    raise
                raise CheckpointError(
                    f"{self.folder.state} is damaged: its part `{name}` cannot be restored "
                    f"({type(error).__name__}: {error})"
                ) from error

    def _write_checkpoint(self, path: Path, step: int, weights: Mapping[str, Tensor]) -> None:
        extra = {"step": str(step), KEY: self.domain.text}
        save(self.model, path, extra=extra, weights=weights)

    def _write_state(self, parts: Mapping[str, State]) -> None:
        # The history must reach the disk first: a state ahead of it would leave a gap.
        self.folder.flush(to_disk=True)
        assert self.model.recipe is not None
        write_state(self.folder.state, self.model.recipe, parts)


class _Weights:
    """Parameters and persistent buffers of a model, by name."""

    def __init__(self, model: nn.Module) -> None:
        self._model = model

    def state(self) -> State:
        return {name: tensor.detach() for name, tensor in unique_tensors(self._model).items()}

    def load_state(self, state: State) -> None:
        load_weights(self._model, state, "the saved state")


@dataclass(frozen=True)
class SavedState:
    """A state file: the recipe of its run, and the states of its parts."""

    recipe: Recipe
    parts: Mapping[str, State]


def write_state(path: Path, recipe: Mapping[str, Any], parts: Mapping[str, State]) -> None:
    """Write `parts` to `path`, whole or not at all; recipe: the resolved tree."""
    tensors: dict[str, Tensor] = {}
    values: dict[str, dict[str, Any]] = {}
    for part, state in parts.items():
        values[part] = {k: v for k, v in state.items() if not isinstance(v, Tensor)}
        for key, tensor in state.items():
            if isinstance(tensor, Tensor):
                # safetensors refuses views and tensors that share memory
                copy = tensor.detach().cpu().clone(memory_format=torch.contiguous_format)
                tensors[f"{part}/{key}"] = copy
    write_tensors(path, tensors, {_PARTS: json.dumps(values), _RECIPE: json.dumps(recipe)})


def read_state(path: Path) -> SavedState:
    """What `write_state` wrote; raises FileNotFoundError, CheckpointError."""
    with TensorFile(path) as file:
        if _PARTS not in file.metadata:
            what = "is no training state; only `qgs train` writes such files"
            raise CheckpointError(f"{path} {what}")
        parts = file.mapping(_PARTS)
        for name, tensor in file.read().items():
            part, _, key = name.partition("/")
            parts.setdefault(part, {})[key] = tensor
        try:
            return SavedState(file.stored_recipe(_RECIPE), parts)
        except RecipeError as error:
            what = f"its recipe fails here, or needs other plugins: {error}"
            raise file.damaged(what) from error


def saved_state(folder: RunFolder, recipe: Recipe) -> SavedState | None:
    """The state from which the run in `folder` continues; None to start it from step 0.

    Raises OtherRunError unless `recipe` equals the run's outside of FREE, CheckpointError when the
    state cannot be read.
    """
    if folder.is_new:
        return None
    # A run that was killed before its first save has a recipe and no state: it starts again.
    saved = read_state(folder.state) if folder.state.is_file() else None
    ours, theirs = flat(recipe.tree), flat((saved.recipe if saved else resolve(folder.recipe)).tree)
    # `refuse_other_data` compares the scenes of a step, which older runs counted by process.
    may_change = tuple(f"{k}." for k in (*FREE, "training.batch_size", "training.accumulate"))
    differing = [
        f"{key}: {ours.get(key, 'absent')} here, {theirs.get(key, 'absent')} in the run"
        for key in dict.fromkeys([*ours, *theirs])
        if ours.get(key) != theirs.get(key) and not f"{key}.".startswith(may_change)
    ]
    if differing:
        raise OtherRunError(
            f"{folder.path} holds a run with another recipe, which cannot be continued with this "
            "one:"
            + "".join(f"\n  {line:.500}" for line in differing)
            + f"\nContinue it with its own recipe, {folder.recipe}, or choose another folder. "
            f"Only these may change: {', '.join(FREE)}."
        )
    return saved


def refuse_other_data(saved: State, now: State, folder: RunFolder) -> None:
    """Raise OtherRunError unless steps see the same data in number and order as before.

    saved, now: "step_size", samples of a step over all processes; "scenes", `scenes_fingerprint`.
    """
    # Sample k depends on its number alone, so equal step sizes give the same batches.
    if saved["step_size"] != now["step_size"]:
        raise OtherRunError(
            f"the optimiser steps of the run in {folder.path} see {saved['step_size']} samples, "
            f"here they would see {now['step_size']}: add "
            f"--set training.batch_size={saved['step_size']}"
        )
    if saved["scenes"] != now["scenes"]:
        raise OtherRunError(
            f"the data lists other training scenes than when {folder.state} was saved: bring back "
            "what was added or removed, or start a new run"
        )
