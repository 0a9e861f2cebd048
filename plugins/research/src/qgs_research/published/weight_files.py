"""Reader of published weights: flat state dicts in safetensors files or torch files."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from qgs.checkpoint.tensors import CheckpointError, TensorFile, pickle_kind
from qgs.wording import listed

TORCH = (".pt", ".pth", ".bin", ".ckpt")
NESTING = ("model", "state_dict", "module")
"""Keys under which training scripts store the state dict in a file with other values."""


@dataclass(frozen=True)
class WeightFile:
    """State dict that was found in a file.

    tensors: tensors by name, memory-mapped if the format allows it. notes: lines that say how the
    state dict was found in the file.
    """

    path: Path
    tensors: Mapping[str, Tensor]
    notes: tuple[str, ...] = ()


def read_weight_file(path: str | Path) -> WeightFile:
    """Open the state dict in a file. Memory-mapped tensors are read when they are used.

    Raises FileNotFoundError for a missing file, and CheckpointError for a file that does not hold a
    state dict of tensors.
    """
    path = Path(path)
    notes = list[str]()
    if not path.is_file():
        raise FileNotFoundError(f"there is no file of weights {path}; correct the path")
    if path.suffix.lower() == ".safetensors":
        with TensorFile(path) as file:
            # An import would lose its recipe.
            if "qgs.recipe" in file.metadata:
                raise CheckpointError(
                    f"{path} is already a qgs checkpoint, so there is nothing to import; use it as "
                    "it is"
                )
            tensors = file.read()
    elif path.suffix.lower() in TORCH:
        tensors = _read_torch(path, notes)
    else:
        known = ", ".join((".safetensors", *TORCH))
        raise CheckpointError(f"{path}: the name of a file of weights must end in one of {known}")
    if not tensors:
        raise CheckpointError(f"{path} holds no tensors; save `model.state_dict()` to this file")
    return WeightFile(path, tensors, tuple(notes))


def _read_torch(path: Path, notes: list[str]) -> dict[str, Tensor]:
    zipped = "zip" in pickle_kind(path)  # only these can be memory-mapped
    try:
        content = torch.load(path, map_location="cpu", weights_only=True, mmap=zipped)
    except Exception as error:  # whatever torch raises about a file that it cannot read
        raise CheckpointError(
            f"{path} cannot be read as a torch file of tensors ({type(error).__name__}): it is "
            "incomplete, or it holds Python objects, which could run code. Copy it again, or save "
            "only `model.state_dict()`"
        ) from error
    try:
        return _state_dict(content, path, notes)
    except RecursionError:  # a dict may hold itself
        raise CheckpointError(
            f"{path}: the weights are nested too deeply; save only `model.state_dict()`"
        ) from None


def _state_dict(content: Any, path: Path, notes: list[str]) -> dict[str, Tensor]:
    """Return the state dict in `content`: `content` itself, or the value of a key in NESTING."""
    if not isinstance(content, Mapping):
        raise CheckpointError(
            f"{path} holds a {type(content).__name__}, not a state dict; save only "
            "`model.state_dict()`"
        )
    # A training script stores other values too, usually one level above the weights.
    others = [str(key) for key, value in content.items() if not isinstance(value, Tensor)]
    if not others:
        return {str(name): tensor.detach() for name, tensor in content.items()}
    inner = [key for key in NESTING if isinstance(content.get(key), Mapping)]
    # The user must choose between two state dicts, for example one of a moving average.
    if len(inner) != 1:
        raise CheckpointError(
            f"{path} holds entries that are not tensors ({listed(others)}), and a state dict is "
            f"expected under exactly one of the keys {', '.join(NESTING)}, but found under "
            f"{', '.join(inner) or 'none'}. Save only the state dict"
        )
    left = [str(key) for key in content if key != inner[0]]
    beside = f"; left out: {listed(left)}" if left else ""
    notes.append(f"the weights are below the key {inner[0]!r}{beside}")
    return _state_dict(content[inner[0]], path, notes)
