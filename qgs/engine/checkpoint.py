"""What continues a run: its state on disk, resuming it, starting from another one's weights."""

from __future__ import annotations

import json
import os
import random
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, TypeAlias

import numpy as np
import torch
from accelerate import Accelerator
from accelerate.utils import gather_object
from safetensors import safe_open
from torch import Tensor, nn

import qgs
from qgs.composer import Recipe, resolve
from qgs.engine.distributed import placed_like, whole
from qgs.engine.folder import RunFolder, checkpoint_of
from qgs.io.checkpoint import (
    CheckpointError,
    load_recipe,
    load_weights,
    opened_tensors,
    unique_tensors,
    write_tensors,
)
from qgs.io.differences import differing_tensors, options_beside_weights, shapes_of
from qgs.model import QueryGaussianModel

FORMAT_VERSION = 1
"""Raised when the layout of the file changes."""

_PARTS, _RECIPE = "qgs.state", "qgs.recipe"
_FORMAT, _VERSION = "qgs.state_version", "qgs.version"

State: TypeAlias = Mapping[str, Any]
"""Tensors and JSON values by name."""


class Stateful(Protocol):
    """A part of a run that must be continued where it stopped."""

    def state(self) -> State:
        """Whole tensors and JSON values that continue this object; all processes must call it."""
        ...

    def load_state(self, state: State) -> None:
        """Become what `state` was taken from."""
        ...


@dataclass(frozen=True)
class SavedState:
    """A state file: the recipe of its run, and the states of parts by name."""

    recipe: Recipe
    parts: Mapping[str, State]


def write_state(
    path: str | os.PathLike[str], recipe: Mapping[str, Any], parts: Mapping[str, State]
) -> None:
    """Write `parts` to `path`, whole or not at all; recipe: the resolved tree.

    Raises OSError when the disk is full.
    """
    tensors: dict[str, Tensor] = {}
    values: dict[str, dict[str, Any]] = {}
    for part, state in parts.items():
        values[part] = {k: v for k, v in state.items() if not isinstance(v, Tensor)}
        for key, tensor in state.items():
            if isinstance(tensor, Tensor):
                tensors[f"{part}/{key}"] = tensor.cpu().clone(memory_format=torch.contiguous_format)
    metadata = {
        _PARTS: json.dumps(values),
        _RECIPE: json.dumps(recipe),
        _FORMAT: str(FORMAT_VERSION),
        _VERSION: qgs.__version__,
    }
    write_tensors(path, tensors, metadata)


def read_state(path: str | os.PathLike[str]) -> SavedState:
    """What `write_state` wrote.

    Raises FileNotFoundError, CheckpointError, and the composer's error when a plugin is missing.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"no training state at {path}")
    with opened_tensors(path) as file:
        metadata = file.metadata() or {}
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    if _PARTS not in metadata:
        raise CheckpointError(f"{path} is no training state; only `qgs train` writes such files")
    if int(metadata[_FORMAT]) > FORMAT_VERSION:
        raise CheckpointError(
            f"{path} was written by qgs {metadata[_VERSION]} with {_FORMAT} {metadata[_FORMAT]}; "
            f"this is qgs {qgs.__version__}, which knows {FORMAT_VERSION}: install the newer qgs"
        )
    parts: dict[str, dict[str, Any]] = json.loads(metadata[_PARTS])
    for name, tensor in tensors.items():
        part, key = name.split("/", 1)
        parts[part][key] = tensor
    return SavedState(resolve(json.loads(metadata[_RECIPE])), parts)


class Weights:
    """Parameters and persistent buffers of a module, by name."""

    def __init__(self, module: nn.Module) -> None:
        self._module = module

    def state(self) -> dict[str, Tensor]:
        """See `Stateful`."""
        return {name: whole(tensor) for name, tensor in unique_tensors(self._module).items()}

    @torch.no_grad()
    def load_state(self, state: State) -> None:
        """See `Stateful`."""
        for name, tensor in unique_tensors(self._module).items():
            tensor.copy_(placed_like(state[name], tensor))


class Moments:
    """What an optimiser remembers of the parameters of `module`, by name."""

    def __init__(self, module: nn.Module, optimizer: torch.optim.Optimizer) -> None:
        self._parameters = dict(module.named_parameters())
        self._optimizer = optimizer

    def state(self) -> dict[str, Tensor]:
        """See `Stateful`."""
        return {
            f"{name}/{key}": whole(value)
            for name, parameter in self._parameters.items()
            for key, value in self._optimizer.state.get(parameter, {}).items()
        }

    def load_state(self, state: State) -> None:
        """See `Stateful`."""
        self._optimizer.state.clear()
        for path, value in state.items():
            name, key = path.rsplit("/", 1)
            parameter = self._parameters[name]
            self._optimizer.state[parameter][key] = placed_like(value, parameter)


def set_seed(seed: int) -> None:
    """Seed python, numpy and torch on all devices."""
    random.seed(seed)
    np.random.seed(seed)
    torch.manual_seed(seed)


class RandomStates:
    """The generators of python, numpy and torch, of every process by its rank."""

    def __init__(self, accelerator: Accelerator) -> None:
        self._accelerator = accelerator

    def state(self) -> dict[str, Any]:
        """See `qgs.engine.checkpoint.Stateful`."""
        own = [_generators(self._accelerator.device)]
        ranks = gather_object(own) if self._accelerator.num_processes > 1 else own
        return {f"{rank}/{key}": v for rank, state in enumerate(ranks) for key, v in state.items()}

    def load_state(self, state: Mapping[str, Any]) -> None:
        """See `qgs.engine.checkpoint.Stateful`; a rank that `state` does not know keeps its own."""
        prefix = f"{self._accelerator.process_index}/"
        own = {k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)}
        if own:
            _restore_generators(own, self._accelerator.device)


def _generators(device: torch.device) -> dict[str, Any]:
    version, words, gauss = random.getstate()
    numpy_state = np.random.get_state(legacy=False)
    assert isinstance(numpy_state, dict)
    twister = numpy_state["state"]
    state: dict[str, Any] = {
        "python": [version, list(words), gauss],
        "numpy": {**numpy_state, "state": {**twister, "key": twister["key"].tolist()}},
        "torch": torch.get_rng_state(),
    }
    if device.type == "cuda":
        state["cuda"] = torch.cuda.get_rng_state(device)
    return state


def _restore_generators(state: Mapping[str, Any], device: torch.device) -> None:
    version, words, gauss = state["python"]
    random.setstate((version, tuple(words), gauss))
    twister = {**state["numpy"]["state"]}
    twister["key"] = np.array(twister["key"], np.uint32)
    np.random.set_state({**state["numpy"], "state": twister})
    torch.set_rng_state(state["torch"])
    if device.type == "cuda" and "cuda" in state:
        torch.cuda.set_rng_state(state["cuda"], device)


FREE = (
    "training.steps",
    "training.seconds",
    "training.save_every",
    "training.collapse_window",
    "training.workers",
    "training.render_views",
    "training.on_nonfinite",
    "training.evaluate_every",
    "training.trackers",
    "evaluation",
    "metrics",
    "data.path",
)
"""Parts of a recipe that may change when a run is continued.

The budget may: the learning rate then follows the new one from there. The others say how long to
watch, where data lies and what is reported, not what is learnt. `training.batch_size` and
`training.accumulate` may change too, as long as a step sees as many samples over all processes.
"""

_COUNTED = ("training.batch_size", "training.accumulate")


class OtherRunError(ValueError):
    """A run cannot be continued with this recipe, these processes or this data."""


def saved_state(folder: RunFolder, recipe: Recipe) -> SavedState | None:
    """The state from which the run in `folder` continues with `recipe`; None to start it.

    A run that was killed before it first saved starts again.
    Raises FileExistsError when the folder holds something else, OtherRunError when the run has
    another recipe, CheckpointError when the state cannot be read.
    """
    folder.refuse_foreign()
    if folder.is_new:
        return None
    saved = read_state(folder.state) if folder.state.is_file() else None
    refuse_another(recipe, saved.recipe if saved else resolve(folder.recipe), folder)
    return saved


def refuse_another(recipe: Recipe, trained: Recipe, folder: RunFolder) -> None:
    """Raise OtherRunError unless `recipe` learns what `trained`, the run's recipe, does."""
    ours, theirs = dict(_leaves(recipe.tree)), dict(_leaves(trained.tree))
    keys = [*ours, *(key for key in theirs if key not in ours)]
    differing = [
        f"{key}: {ours.get(key, 'absent')} here, {theirs.get(key, 'absent')} in the run"
        for key in keys
        if ours.get(key) != theirs.get(key) and not _free(key)
    ]
    if differing:
        raise OtherRunError(
            f"the run in {folder.path} has another recipe and cannot be continued with this one:"
            + "".join(f"\n  {line}" for line in differing)
            + f"\nContinue it with its own recipe, {folder.recipe}, or choose another folder. "
            f"Only these may change: {', '.join(FREE)}."
        )


def refuse_other_conditions(
    saved: Mapping[str, Any], now: Mapping[str, Any], folder: RunFolder
) -> None:
    """Raise OtherRunError unless steps see the same data in number and order as before.

    saved, now: "step_size", samples of an optimiser step over all processes, and "scenes", the
    fingerprint of `qgs.data.stream.SceneOrder`.
    """
    if saved["step_size"] != now["step_size"]:
        raise OtherRunError(
            f"an optimiser step of the run in {folder.path} sees {saved['step_size']} samples, "
            f"here it would see {now['step_size']}: choose training.batch_size, "
            "training.accumulate and the number of processes with the same product"
        )
    if saved["scenes"] != now["scenes"]:
        raise OtherRunError(
            f"the data lists other training scenes than when the run in {folder.path} was saved: "
            "bring back what was added or removed, or start a new run"
        )


def _free(key: str) -> bool:
    return key in _COUNTED or any(key == free or key.startswith(f"{free}.") for free in FREE)


def _leaves(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted path and value of everything in `tree` that is no mapping with entries."""
    for key, value in tree.items():
        if isinstance(value, Mapping) and value:
            yield from _leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


QUERIES = "queries."


def initialise(model: QueryGaussianModel, recipe: Recipe) -> list[str]:
    """Give `model`, freshly built from `recipe`, the weights that `recipe.init_from` names.

    `init_from` is a checkpoint or the folder of a run, relative to the working directory; without
    it the model stays as it is. Queries grow or shrink by their own rule (`Queries.resized`) with
    random numbers of the recipe's seed; everything else must have the same names and shapes.

    Returns what was done, line by line, with the options that make the same weights predict other
    Gaussians than where they were learned. Raises FileNotFoundError, and CheckpointError with every
    difference and with the options that would fit.
    """
    if recipe.init_from is None:
        return []
    path = checkpoint_of(Path(recipe.init_from).expanduser())
    learned_by = load_recipe(path)
    with safe_open(path, "pt") as file:
        learned = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    options = _differing_options(learned_by, recipe)
    found = _differences(learned, model, learned_by.build_model("meta").queries.count)
    if found:
        raise CheckpointError(_refusal(path, found, options))
    generator = torch.Generator().manual_seed(recipe.seed)
    queries = {k.removeprefix(QUERIES): v for k, v in learned.items() if k.startswith(QUERIES)}
    resized = model.queries.resized(queries, generator)
    weights = learned | {QUERIES + name: values for name, values in resized.items()}
    load_weights(model, weights, str(path))
    resizings = [
        _told(name, len(learned[name]), len(values))
        for name, values in weights.items()
        if values.shape != learned[name].shape
    ]
    others = [f"learned with {option}" for option in options]
    return [f"weights start from {path}", *resizings, *others]


def _told(name: str, old: int, new: int) -> str:
    if new < old:
        return f"{name}: {old} -> {new}, the first are kept"
    return f"{name}: {old} -> {new}, {old} kept, {new - old} noisy copies of them"


def _differences(learned: Mapping[str, Tensor], model: QueryGaussianModel, count: int) -> list[str]:
    """In what the weights of a model of `count` queries differ, besides that number."""
    own, theirs = shapes_of(unique_tensors(model)), shapes_of(learned)
    for name in own.keys() & theirs.keys():
        ours, shape = own[name], theirs[name]
        per_query = ours[:1] == (model.queries.count,) and shape[:1] == (count,)
        if name.startswith(QUERIES) and per_query and ours[1:] == shape[1:]:
            del own[name], theirs[name]
    return differing_tensors(theirs, own)


def _refusal(path: Path, found: Iterable[str], options: Iterable[str]) -> str:
    return "\n  ".join(
        [f"init_from: {path} does not fit this recipe; only the number of queries may differ:"]
        + [*found, "options of the model that the checkpoint was trained with:"]
        + [f"  {option}" for option in options]
    )


def _differing_options(learned_by: Recipe, recipe: Recipe) -> list[str]:
    """Options of the model, the number of queries aside, in which two recipes differ."""
    apart = options_beside_weights(learned_by.tree, recipe.tree)
    return [
        f"{path}: {theirs} (here {ours})"
        for path, (theirs, ours) in apart.items()
        if path != "model.queries.count"
    ]


class Counters:
    """Optimiser steps, and samples drawn over all processes.

    conditions: what must be as it was for these numbers to mean the same when the run in `folder`
    is continued, see `qgs.engine.checkpoint.refuse_other_conditions`.
    """

    def __init__(self, conditions: Mapping[str, Any], folder: RunFolder) -> None:
        self.step = 0
        self.samples = 0
        self._conditions = conditions
        self._folder = folder

    def state(self) -> dict[str, Any]:
        """See `qgs.engine.checkpoint.Stateful`."""
        return {"step": self.step, "samples": self.samples, **self._conditions}

    def load_state(self, state: Mapping[str, Any]) -> None:
        """See `qgs.engine.checkpoint.Stateful`. Raises OtherRunError."""
        refuse_other_conditions(state, self._conditions, self._folder)
        self.step, self.samples = state["step"], state["samples"]
