"""What a run saves and continues from."""

import json
import math
import os
import random
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias

import numpy as np
import torch
from accelerate import Accelerator
from accelerate.utils import gather_object
from torch import Tensor, nn

import qgs
from qgs.composer import Recipe, RecipeError, resolve
from qgs.composer.recipe import flat
from qgs.contracts.schedule import follow, steps_followed
from qgs.data.domain import KEY, SAMPLES, Domain
from qgs.data.sampling import Batch
from qgs.engine.distributed import placed_like, sharded, whole
from qgs.engine.folder import RunFolder
from qgs.io.checkpoint import load_weights, save, unique_tensors
from qgs.io.tensors import (
    CheckpointError,
    TensorFile,
    differing_tensors,
    differing_types,
    nonfinite,
    shapes_of,
    write_tensors,
)
from qgs.model import QueryGaussianModel
from qgs.wording import listed

FORMAT_VERSION = 1
"""Raised when the format of the file changes."""

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
        """Restore from `state`."""
        ...


@dataclass(frozen=True)
class SavedState:
    """A state file: the recipe of its run, the states of its parts, its error for damage."""

    recipe: Recipe
    parts: Mapping[str, State]
    damaged: Callable[[str], CheckpointError]


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
        _RECIPE: json.dumps(recipe),
        _FORMAT: str(FORMAT_VERSION),
        _VERSION: qgs.__version__,
    }
    write_tensors(path, tensors, metadata)


def read_state(path: str | os.PathLike[str]) -> SavedState:
    """What `write_state` wrote; raises FileNotFoundError, CheckpointError, RecipeError."""
    with TensorFile(path) as file:
        if _PARTS not in file.metadata:
            raise CheckpointError(
                f"{path} is no training state; only `qgs train` writes such files"
            )
        file.refuse_newer(_FORMAT, FORMAT_VERSION)
        parts = file.mapping(_PARTS)
        for name, tensor in file.read().items():
            part, slash, key = name.partition("/")
            if not slash or not isinstance(parts.get(part), dict):
                raise file.damaged(f"the tensor `{name[:200]}` belongs to no part of a run")
            parts[part][key] = tensor
        try:
            return SavedState(file.stored_recipe(_RECIPE), parts, file.damaged)
        except RecipeError as error:
            what = f"its recipe fails here, or needs other plugins: {error}"
            raise file.damaged(what) from error


def number_in(state: State, name: str, kind: type = int) -> Any:
    """The finite number, 0 or more, of `kind` (int or float) that `state` has under `name`.

    Raises ValueError for anything else, KeyError for nothing.
    """
    value = state[name]
    if type(value) not in (kind, int) or not 0 <= value < math.inf:
        raise ValueError(f"{name} is {str(value)[:100]!r}")
    return value


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
        self.domain = Domain()
        self.parts: dict[str, Stateful] = {"weights": Weights(model), "domain": self.domain}

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
        copy = resolve(self.model.recipe).build_model(pretrained=False)
        load_weights(copy, self.parts["weights"].state(), "the model in shards")
        follow(copy.modules(), steps_followed(self.model.modules()) or 0)
        return copy.to(self._accelerator.device)

    def restore(self, saved: SavedState) -> None:
        """Bring every part back to where `saved` was taken; raises CheckpointError."""
        missing = [name for name in self.parts if name not in saved.parts]
        if missing:
            raise CheckpointError(
                f"{self.folder.state} lacks {listed(missing)}: another version of qgs wrote "
                "it; continue the run with that version"
            )
        for name, part in self.parts.items():
            try:
                fault = broken(saved.parts[name], name)
                if not fault:
                    part.load_state(saved.parts[name])
            except OtherRunError:
                raise
            except Exception as error:  # whatever a part, or a plugin's, raises about its state
                known = isinstance(error, CheckpointError)
                fault = str(error) if known else f"{type(error).__name__}: {error}"
            if fault:
                raise saved.damaged(f"its part `{name}` cannot be restored ({fault})")

    def _extra(self, step: int) -> dict[str, str]:
        return {"step": str(step), KEY: self.domain.text}

    def _write_state(self, parts: Mapping[str, State]) -> None:
        self.folder.flush(to_disk=True)
        assert self.model.recipe is not None
        write_state(self.folder.state, self.model.recipe, parts)


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


_SQUARES = {"exp_avg_sq", "max_exp_avg_sq", "square_avg", "sum", "variance", "row_var", "col_var"}
"""Where torch's optimisers keep squares of gradients, which finite gradients may make infinite."""


def broken(state: State, part: str) -> str:
    """The tensors of `state` with values that no sound run has, in words; "" for none."""
    tensors = {k: v for k, v in state.items() if isinstance(v, Tensor)}
    kinds = {k: k.rpartition("/")[2] if part == "moments" else "" for k in tensors}
    bad = nonfinite((k, v) for k, v in tensors.items() if kinds[k] not in _SQUARES)
    counted = [k for k, kind in kinds.items() if kind in _SQUARES | {"step"}]
    negative = [k for k in counted if not bool((tensors[k] >= 0).all())]  # or NaN
    told = {"not finite": bad, "negative or NaN": [k for k in negative if k not in bad]}
    return "; ".join(f"{what}: {listed(names)}" for what, names in told.items() if names)


class OptimizerState:
    """What torch's optimiser remembers of the parameters of `module` that it trains, by name.

    "idle" lists those of which it remembers nothing, because no gradient has reached them.
    """

    def __init__(self, module: nn.Module, optimizer: torch.optim.Optimizer) -> None:
        trained = {id(p) for group in optimizer.param_groups for p in group["params"]}
        self._parameters = {n: p for n, p in module.named_parameters() if id(p) in trained}
        self._optimizer = optimizer

    def state(self) -> dict[str, Any]:
        kept = {name: self._optimizer.state.get(p, {}) for name, p in self._parameters.items()}
        return {"idle": [name for name, values in kept.items() if not values]} | {
            f"{name}/{key}": whole(value) if isinstance(value, Tensor) else value
            for name, values in kept.items()
            for key, value in values.items()
        }

    def load_state(self, state: State) -> None:
        self._optimizer.state.clear()
        names = {path: path.rpartition("/")[0] for path in state if path != "idle"}
        kept, idle = {*names.values()}, {*state["idle"]}
        if differing := sorted((kept | idle) ^ self._parameters.keys()):
            raise CheckpointError(f"not of the parameters that are trained: {listed(differing)}")
        if both := sorted(kept & idle):
            raise CheckpointError(f"both with moments and without: {listed(both)}")
        made, alone = self._made()
        made = {k: v for k, v in made.items() if k.rpartition("/")[0] in kept}
        if alone and (others := sorted(names.keys() - made.keys())):
            raise CheckpointError(f"not of this optimiser: {listed(others)}")
        wanted = {k: v for k, v in made.items() if isinstance(v, Tensor)}
        refuse_other_tensors({key: state[key] for key in wanted if key in state}, wanted)
        for path, name in names.items():
            parameter, value = self._parameters[name], state[path]
            if isinstance(value, Tensor):
                value = placed_like(value, parameter)
            self._optimizer.state[parameter][path.removeprefix(f"{name}/")] = value

    def _made(self) -> tuple[dict[str, Any], bool]:
        """What a first step makes, in shape and type, and whether that is all.

        Where steps need numbers it is what they prepare before.
        """
        alike = {
            name: nn.Parameter(torch.empty(p.shape, dtype=p.dtype, device="meta"))
            for name, p in self._parameters.items()
        }
        memo = {id(p): alike[name] for name, p in self._parameters.items()}
        for parameter in alike.values():
            parameter.grad = torch.empty_like(parameter)
        optimizer = deepcopy(getattr(self._optimizer, "optimizer", self._optimizer), memo)
        alone = True
        for group in list(optimizer.param_groups):
            optimizer.param_groups = [group]
            group.update({key: False for key in ("fused", "foreach") if key in group})
            try:
                optimizer.step()
            except Exception:  # whatever an optimiser does with numbers that are not there
                alone = False
        state = optimizer.state
        return {f"{n}/{k}": v for n, p in alike.items() for k, v in state[p].items()}, alone


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
