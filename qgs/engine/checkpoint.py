"""What a run saves and continues from; starting from the weights of another one."""

import json
import math
import os
import random
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, TypeAlias
from zlib import crc32

import numpy as np
import torch
from accelerate import Accelerator
from accelerate.utils import gather_object
from torch import Tensor, nn

import qgs
from qgs.composer import Recipe, RecipeError, resolve
from qgs.composer.recipe import flat
from qgs.data.domain import KEY, SAMPLES, Domain
from qgs.data.sampling import Batch
from qgs.engine.distributed import placed_like, sharded, whole
from qgs.engine.folder import RunFolder, checkpoint_of
from qgs.io.checkpoint import (
    CheckpointError,
    load_domain,
    load_recipe,
    load_weights,
    opened_tensors,
    read_tensors,
    save,
    unique_tensors,
    write_tensors,
)
from qgs.io.differences import (
    differing_tensors,
    differing_types,
    options_beside_weights,
    shapes_of,
)
from qgs.io.metadata import damaged, mapping_in, refuse_newer, stored_recipe
from qgs.model import QueryGaussianModel
from qgs.wording import listed

FORMAT_VERSION = 1
"""Raised when the format of the file changes."""

_PARTS, _RECIPE = "qgs.state", "qgs.recipe"
_FORMAT, _VERSION, _TENSORS = "qgs.state_version", "qgs.version", "qgs.contents"

State: TypeAlias = Mapping[str, Any]
"""Tensors and JSON values by name."""


class Stateful(Protocol):
    """A part of a run that must be continued where it stopped."""

    def state(self) -> State:
        """Whole tensors and JSON values that continue this object; all processes must call it."""
        ...

    def load_state(self, state: State) -> None:
        """Restore from `state`."""
        ...


@dataclass(frozen=True)
class SavedState:
    """A state file: the recipe of its run, and the states of its parts."""

    recipe: Recipe
    parts: Mapping[str, State]


def write_state(
    path: str | os.PathLike[str], recipe: Mapping[str, Any], parts: Mapping[str, State]
) -> None:
    """Write `parts` to `path`, whole or not at all; recipe: the resolved tree."""
    tensors: dict[str, Tensor] = {}
    values: dict[str, dict[str, Any]] = {}
    for part, state in parts.items():
        values[part] = {k: v for k, v in state.items() if not isinstance(v, Tensor)}
        for key, tensor in state.items():
            if isinstance(tensor, Tensor):
                tensors[f"{part}/{key}"] = tensor.cpu().clone(memory_format=torch.contiguous_format)
    metadata = {
        _PARTS: json.dumps(values),
        _TENSORS: json.dumps(contents(tensors)),
        _RECIPE: json.dumps(recipe),
        _FORMAT: str(FORMAT_VERSION),
        _VERSION: qgs.__version__,
    }
    write_tensors(path, tensors, metadata)


def read_state(path: str | os.PathLike[str]) -> SavedState:
    """What `write_state` wrote; raises FileNotFoundError, CheckpointError, RecipeError."""
    if not Path(path).is_file():
        raise FileNotFoundError(f"no training state at {path}")
    with opened_tensors(path) as file:
        metadata = file.metadata() or {}
    if _PARTS not in metadata:
        raise CheckpointError(f"{path} is no training state; only `qgs train` writes such files")
    refuse_newer(metadata, {_FORMAT: FORMAT_VERSION}, _VERSION, path)
    parts, tensors = mapping_in(metadata, _PARTS, path), read_tensors(path)
    _refuse_others(tensors, metadata, path)
    for name, tensor in tensors.items():
        part, slash, key = name.partition("/")
        if not slash or not isinstance(parts.get(part), dict):
            raise damaged(path, f"the tensor `{name[:200]}` belongs to no part of a run")
        parts[part][key] = tensor
    try:
        return SavedState(stored_recipe(metadata, _RECIPE, path), parts)
    except RecipeError as error:
        raise damaged(path, f"its recipe fails here, or needs other plugins: {error}") from error


def contents(tensors: Mapping[str, Tensor]) -> dict[str, str]:
    """What tells tensors on the CPU from others: types, shapes, checksums of their bytes."""
    sums = {n: crc32(t.reshape(-1).view(torch.uint8).numpy().data) for n, t in tensors.items()}
    return {n: f"{t.dtype} {list(t.shape)} crc32 {sums[n]:08x}" for n, t in tensors.items()}


def _refuse_others(tensors: Mapping[str, Tensor], metadata: Mapping[str, str], path: Any) -> None:
    """Raise CheckpointError unless `tensors` are those that were written; old files do not tell."""
    found = contents(tensors)
    wanted = mapping_in(metadata, _TENSORS, path) if _TENSORS in metadata else found
    differing = [
        f"{name[:200]}: {found.get(name, 'absent')} instead of {str(wanted.get(name))[:200]}"
        for name in dict.fromkeys([*wanted, *found])
        if found.get(name) != wanted.get(name)
    ]
    if differing:
        raise damaged(path, f"not the tensors that were written: {listed(differing, between='; ')}")


class Saver:
    """Writes the checkpoint and the state of a run; of several processes, the main one writes.

    parts: everything that continues the run, by name; checkpoints hold "weights" and "ema".
    domain: of the first samples of the training, which checkpoints tell too.
    Each file appears whole or not at all; the state, complete by itself, comes last. All processes
    must call each method together.
    """

    def __init__(
        self, accelerator: Accelerator, folder: RunFolder, model: QueryGaussianModel
    ) -> None:
        self._accelerator, self.folder, self.model = accelerator, folder, model
        self.parts: dict[str, Stateful] = {"weights": Weights(model)}
        self.domain = Domain()

    def see(self, batches: Sequence[Batch]) -> None:
        """Count the cameras of a step's batches into `domain`, until it has enough."""
        for batch in batches:
            if self.domain.samples < SAMPLES:
                self.domain.see(batch.inputs.cameras, batch.targets.cameras)

    def save(self, step: int, state_only: bool = False) -> None:
        """Save the run after `step` optimiser steps; `state_only` leaves the checkpoints."""
        parts = {name: part.state() for name, part in self.parts.items()}
        if self._accelerator.is_main_process:
            self.folder.refuse_gone()
            if not state_only:
                if not self.folder.state.exists():
                    self._write_state(parts)  # a checkpoint alone cannot be continued
                extra = self._extra(step)
                save(self.model, self.folder.checkpoint, extra=extra, weights=parts["weights"])
                if "ema" in parts:
                    save(self.model, self.folder.checkpoint_ema, extra=extra, weights=parts["ema"])
            self._write_state(parts)
        self._accelerator.wait_for_everyone()

    def save_checkpoint(self, step: int, weights: Mapping[str, Tensor]) -> None:
        """Save a checkpoint of other weights than the present ones."""
        if self._accelerator.is_main_process:
            self.folder.refuse_gone()
            save(self.model, self.folder.checkpoint, extra=self._extra(step), weights=weights)
        self._accelerator.wait_for_everyone()

    def whole_model(self) -> QueryGaussianModel:
        """The model, as a copy of its own where its weights lie in shards."""
        if not sharded(self.model):
            return self.model
        assert self.model.recipe is not None
        copy = resolve(self.model.recipe).build_model()
        load_weights(copy, self.parts["weights"].state(), "the model in shards")
        return copy.to(self._accelerator.device)

    def restore(self, saved: SavedState) -> None:
        """Bring every part back to where `saved` was taken; raises CheckpointError."""
        missing = [name for name in self.parts if name not in saved.parts]
        if missing:
            raise CheckpointError(
                f"{self.folder.state} lacks {', '.join(missing)}: another version of qgs wrote "
                "it; continue the run with that version"
            )
        for name, part in self.parts.items():
            fault = unlike(part.state(), saved.parts[name]) or broken(saved.parts[name], name)
            try:
                if not fault:
                    part.load_state(saved.parts[name])
            except OtherRunError:
                raise
            except Exception as error:  # whatever a part, or a plugin's, raises about its state
                known = isinstance(error, CheckpointError)
                fault = str(error) if known else f"{type(error).__name__}: {error}"
            if fault:
                raise damaged(self.folder.state, f"its part `{name}` cannot be restored ({fault})")
        if self.folder.checkpoint.is_file():
            self.domain = load_domain(self.folder.checkpoint)

    def _extra(self, step: int) -> dict[str, str]:
        return {"step": str(step), KEY: self.domain.text}

    def _write_state(self, parts: Mapping[str, State]) -> None:
        self.folder.flush(to_disk=True)
        assert self.model.recipe is not None
        write_state(self.folder.state, self.model.recipe, parts)


def unlike(now: Any, saved: Any, name: str = "") -> str:
    """Where JSON values that were saved are of another kind than those of today; "" if nowhere.

    Numbers and mappings are compared; a text may have been null, a list of another length.
    """
    if isinstance(now, Mapping):
        if not isinstance(saved, Mapping):
            return f"{name or 'it'} is no mapping"
        found = (
            unlike(value, saved[key], f"{name}.{key}".removeprefix("."))
            for key, value in now.items()
            if not isinstance(value, Tensor)
            if key in saved
        )
        return next(filter(None, found), "")
    if isinstance(now, int | float):
        sound = type(saved) is type(now) or (type(now), type(saved)) == (float, int)
        if not sound or not (0 if type(now) is int else -math.inf) <= saved < math.inf:
            return f"{name} is {str(saved)[:100]!r}"
    return ""


class Weights:
    """Parameters and persistent buffers of a module, by name."""

    def __init__(self, module: nn.Module) -> None:
        self._module = module

    def state(self) -> dict[str, Tensor]:
        return {name: whole(tensor) for name, tensor in unique_tensors(self._module).items()}

    @torch.no_grad()
    def load_state(self, state: State) -> None:
        self.refuse_unlike(state)
        for name, tensor in unique_tensors(self._module).items():
            tensor.copy_(placed_like(state[name], tensor))

    def refuse_unlike(self, state: State) -> None:
        """Raise CheckpointError for other names, shapes and types than the module's."""
        refuse_other_tensors(state, unique_tensors(self._module))


def refuse_other_tensors(saved: State, wanted: Mapping[str, Tensor]) -> None:
    """Raise CheckpointError unless `saved` has the names, shapes and types of `wanted` alone."""
    differences = differing_tensors(shapes_of(saved), shapes_of(wanted))
    if found := differences + differing_types(saved, wanted):
        raise CheckpointError(f"{len(found)} differences: {listed(found, between='; ')}")


def broken(state: State, part: str) -> str:
    """The tensors of `state` with NaN or infinity, which only squares may reach; "" for none."""
    tensors = {k: v for k, v in state.items() if isinstance(v, Tensor)}
    squares = {k for k, v in tensors.items() if part == "moments" and bool((v >= 0).all())}
    names = [k for k, v in tensors.items() if k not in squares and not bool(v.isfinite().all())]
    return f"not finite: {listed(names)}" if names else ""


class OptimizerState:
    """What torch's optimiser remembers of the parameters of `module`, by name."""

    def __init__(self, module: nn.Module, optimizer: torch.optim.Optimizer) -> None:
        self._parameters = dict(module.named_parameters())
        self._optimizer = optimizer

    def state(self) -> dict[str, Any]:
        return {
            f"{name}/{key}": whole(value) if isinstance(value, Tensor) else value
            for name, parameter in self._parameters.items()
            for key, value in self._optimizer.state.get(parameter, {}).items()
        }

    def load_state(self, state: State) -> None:
        self._optimizer.state.clear()
        unknown = [path for path in state if path.rpartition("/")[0] not in self._parameters]
        if unknown:
            raise CheckpointError(f"of no parameter of the model: {listed(unknown)}")
        for path, value in state.items():
            name, key = path.rsplit("/", 1)
            parameter = self._parameters[name]
            if isinstance(value, Tensor):
                value = placed_like(value, parameter)
            self._optimizer.state[parameter][key] = value


class RandomStates:
    """The generators of python, numpy and torch, of every process by its rank."""

    def __init__(self, accelerator: Accelerator) -> None:
        self._accelerator = accelerator

    def state(self) -> dict[str, Any]:
        version, words, gauss = random.getstate()
        own = {
            "python": [version, list(words), gauss],
            "numpy": _with_key(np.random.get_state(legacy=False), np.ndarray.tolist),
            "torch": torch.get_rng_state(),
        }
        device = self._accelerator.device
        if device.type == "cuda":
            own["cuda"] = torch.cuda.get_rng_state(device)
        ranks = gather_object([own]) if self._accelerator.num_processes > 1 else [own]
        return {f"{rank}/{key}": v for rank, state in enumerate(ranks) for key, v in state.items()}

    def load_state(self, state: State) -> None:
        """See `Stateful`; a rank that `state` does not know keeps its own."""
        prefix, device = f"{self._accelerator.process_index}/", self._accelerator.device
        own = {k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)}
        if not own:
            return
        version, words, gauss = own["python"]
        random.setstate((version, tuple(words), gauss))
        np.random.set_state(_with_key(own["numpy"], lambda key: np.array(key, np.uint32)))
        torch.set_rng_state(own["torch"])
        if device.type == "cuda" and "cuda" in own:
            torch.cuda.set_rng_state(own["cuda"], device)


def _with_key(state: Any, function: Callable[[Any], Any]) -> dict[str, Any]:
    """A state of numpy's generator with `function` of the words of its Mersenne Twister."""
    return {**state, "state": {**state["state"], "key": function(state["state"]["key"])}}


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

The budget may: the learning rate then follows the new one from there. The others say how long to
watch, where data lies and what is reported, not what is learnt; plugins that the model uses are
compared by its types. `training.batch_size` and `training.accumulate` may change too, as long as a
step sees as many samples over all processes.
"""


class OtherRunError(ValueError):
    """A run cannot be continued with this recipe, these processes or this data."""


def saved_state(folder: RunFolder, recipe: Recipe) -> SavedState | None:
    """The state from which the run in `folder` continues; None to start it, again if it was killed.

    Raises OtherRunError unless `recipe` equals the run's outside of FREE, CheckpointError when the
    state cannot be read.
    """
    if folder.is_new:
        return None
    saved = read_state(folder.state) if folder.state.is_file() else None
    ours, theirs = flat(recipe.tree), flat((saved.recipe if saved else resolve(folder.recipe)).tree)
    counted = ("training.batch_size", "training.accumulate")
    may_change = tuple(f"{key}." for key in (*FREE, *counted))
    differing = [
        f"{key}: {ours.get(key, 'absent')} here, {theirs.get(key, 'absent')} in the run"
        for key in dict.fromkeys([*ours, *theirs])
        if ours.get(key) != theirs.get(key) and not f"{key}.".startswith(may_change)
    ]
    if differing:
        raise OtherRunError(
            f"{folder.state if saved else folder.recipe} is of a run with another recipe, which "
            "cannot be continued with this one:"
            + "".join(f"\n  {line:.500}" for line in differing)
            + f"\nContinue it with its own recipe, {folder.recipe}, or choose another folder. "
            f"Only these may change: {', '.join(FREE)}."
        )
    return saved


def refuse_other_data(saved: State, now: State, folder: RunFolder) -> None:
    """Raise OtherRunError unless steps see the same data in number and order as before.

    saved, now: "step_size", samples of a step over all processes; "scenes", `scenes_fingerprint`.
    """
    if saved["step_size"] != now["step_size"]:
        raise OtherRunError(
            f"{folder.state} is of a run whose optimiser steps see {saved['step_size']} samples, "
            f"here they would see {now['step_size']}: choose training.batch_size, "
            "training.accumulate and the number of processes with the same product"
        )
    if saved["scenes"] != now["scenes"]:
        raise OtherRunError(
            f"the data lists other training scenes than when {folder.state} was saved: bring back "
            "what was added or removed, or start a new run"
        )


_QUERIES = "queries."


def initialise(model: QueryGaussianModel, recipe: Recipe) -> list[str]:
    """Give `model`, freshly built from `recipe`, the weights that `recipe.init_from` names, if any.

    `init_from` is a checkpoint, the folder of a run, a shipped model or a URL. Queries
    grow or shrink by their own rule (`Queries.resized`) with random numbers of the recipe's seed;
    everything else must have the same names and shapes.

    Returns what was done, line by line, with the options that make the same weights predict other
    Gaussians. Raises FileNotFoundError, CheckpointError with every difference and what would fit.
    """
    if recipe.init_from is None:
        return []
    path = checkpoint_of(recipe.init_from)
    learned_by = load_recipe(path)
    stored = read_tensors(path)
    learned = {name: tensor.float() for name, tensor in stored.items()}
    if fault := broken(learned, "weights"):
        raise CheckpointError(f"init_from: {path} has weights that are {fault}: take another file")
    options = [
        f"{option}: {theirs} (here {ours})"
        for option, (theirs, ours) in options_beside_weights(learned_by.tree, recipe.tree).items()
        if option != "model.queries.count"
    ]
    found = _differences(learned, model, learned_by.build_model("meta").queries.count)
    found += differing_types(stored, unique_tensors(model), widened=True)
    if found:
        first = (
            f"init_from: {path} does not fit this recipe; only the number of queries may differ:"
        )
        trained = "options of the model that the checkpoint was trained with:"
        raise CheckpointError("\n  ".join([first, *found, trained, *(f"  {o}" for o in options)]))
    queries = {k.removeprefix(_QUERIES): v for k, v in learned.items() if k.startswith(_QUERIES)}
    resized = model.queries.resized(queries, torch.Generator().manual_seed(recipe.seed))
    weights = learned | {_QUERIES + name: values for name, values in resized.items()}
    load_weights(model, weights, str(path))
    done = [f"weights start from {path}"]
    for name, values in weights.items():
        if values.shape != learned[name].shape:
            old, new = len(learned[name]), len(values)
            kept = f"{old} kept, {new - old} noisy copies of them"
            done.append(f"{name}: {old} -> {new}, {'the first are kept' if new < old else kept}")
    return done + [f"learned with {option}" for option in options]


def _differences(learned: Mapping[str, Tensor], model: QueryGaussianModel, count: int) -> list[str]:
    """In what the weights of a model of `count` queries differ, besides that number."""
    own, theirs = shapes_of(unique_tensors(model)), shapes_of(learned)
    for name in own.keys() & theirs.keys():
        ours, shape = own[name], theirs[name]
        per_query = ours[:1] == (model.queries.count,) and shape[:1] == (count,)
        if name.startswith(_QUERIES) and per_query and ours[1:] == shape[1:]:
            del own[name], theirs[name]
    return differing_tensors(theirs, own)
