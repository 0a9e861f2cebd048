"""Files of published weights: a flat state dict, in safetensors or as torch saves it."""

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
"""Keys under which training scripts store the state dict, next to an optimiser's state and such."""


@dataclass(frozen=True)
class WeightFile:
    """A flat state dict. tensors: by name, memory-mapped where the format allows it.

    notes: how it was found in the file, a sentence each.
    """

    path: Path
    tensors: Mapping[str, Tensor]
    notes: tuple[str, ...] = ()


def read_weight_file(path: str | Path) -> WeightFile:
    """The state dict in a file; memory-mapped pages are read when they are used.

    Raises FileNotFoundError, and CheckpointError for anything but a state dict of tensors.
    """
    path = Path(path)
    notes = list[str]()
    if not path.is_file():
        raise FileNotFoundError(f"no file of weights at {path}")
    if path.suffix.lower() == ".safetensors":
        with TensorFile(path) as file:
            # Its recipe would be lost on the way.
            if "qgs.recipe" in file.metadata:
                raise CheckpointError(f"{path} is a qgs checkpoint, no published weights")
            tensors = file.read()
    elif path.suffix.lower() in TORCH:
        tensors = _read_torch(path, notes)
    else:
        known = ", ".join((".safetensors", *TORCH))
        raise CheckpointError(f"{path}: weights are read from files named {known}")
    if not tensors:
        raise CheckpointError(f"{path} holds no tensors")
    return WeightFile(path, tensors, tuple(notes))


def _read_torch(path: Path, notes: list[str]) -> dict[str, Tensor]:
    zipped = "zip" in pickle_kind(path)  # only these can be memory-mapped
    try:
        content = torch.load(path, map_location="cpu", weights_only=True, mmap=zipped)
    except Exception as error:  # whatever torch raises about a file that it cannot read
        raise CheckpointError(
            f"{path} is not a whole torch file of plain tensors ({type(error).__name__}); it is "
            "cut off, or holds Python objects, which could run code: copy it again, or save "
            "`model.state_dict()` alone"
        ) from error
    try:
        return _state_dict(content, path, notes)
    except RecursionError:  # a dict may hold itself
        raise CheckpointError(
            f"{path}: the weights lie too deep; save `model.state_dict()` alone"
        ) from None


def _state_dict(content: Any, path: Path, notes: list[str]) -> dict[str, Tensor]:
    """The tensors of a state dict, flat or below the keys in NESTING."""
    if not isinstance(content, Mapping):
        raise CheckpointError(f"{path} holds {type(content).__name__}, no state dict")
    # A training script stores more than weights, as a rule one level above them.
    others = [str(key) for key, value in content.items() if not isinstance(value, Tensor)]
    if not others:
        return {str(name): tensor.detach() for name, tensor in content.items()}
    inner = [key for key in NESTING if isinstance(content.get(key), Mapping)]
    # Of two state dicts (a moving average, say) the user must choose.
    if len(inner) != 1:
        raise CheckpointError(
            f"{path} holds entries that are no tensors ({listed(others)}); one state dict may lie "
            f"below {', '.join(NESTING)}, found {', '.join(inner) or 'none'}: save it alone"
        )
    left = [str(key) for key in content if key != inner[0]]
    beside = f"; left out: {listed(left)}" if left else ""
    notes.append(f"the weights lie below {inner[0]!r}{beside}")
    return _state_dict(content[inner[0]], path, notes)
