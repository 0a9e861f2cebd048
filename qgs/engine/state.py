"""Everything that continues a run, in one safetensors file; no pickle is ever read."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, TypeAlias

import torch
from torch import Tensor, nn

import qgs
from qgs.composer import Recipe, resolve
from qgs.engine.processes import placed_like, whole
from qgs.io.checkpoint import CheckpointError, unique_tensors
from qgs.io.tensors import opened_tensors, write_tensors

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
