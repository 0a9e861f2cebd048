"""Files of published weights: safetensors, or torch's own, whose code is never run."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from qgs.io.tensors import CheckpointError, TensorFile, pickle_kind
from qgs.wording import listed

SAFETENSORS = (".safetensors",)
TORCH = (".pt", ".pth", ".bin", ".ckpt")
NESTING = ("model", "state_dict", "module")
"""Keys under which training scripts store the weights beside other things."""
DISTRIBUTED = "module."
"""What DistributedDataParallel puts before every name."""


@dataclass(frozen=True)
class WeightFile:
    """A flat state dict. tensors: memory-mapped, by name. notes: what was made of the file."""

    path: Path
    tensors: Mapping[str, Tensor]
    notes: tuple[str, ...] = ()


def read_weight_file(path: str | Path) -> WeightFile:
    """The tensors in a file; pages are read when they are used.

    Raises FileNotFoundError and CheckpointError.
    """
    path = Path(path)
    if path.is_dir():
        raise CheckpointError(f"{path} is a folder; give the file of weights in it")
    if not path.is_file():
        raise FileNotFoundError(f"no weights at {path}")
    if not path.stat().st_size:
        raise CheckpointError(f"{path} is empty; copy it again")
    suffix = path.suffix.lower()
    notes: list[str] = []
    if suffix in SAFETENSORS:
        tensors = _read_safetensors(path)
    elif suffix in TORCH:
        tensors = _read_torch(path, notes)
    else:
        known = ", ".join((*SAFETENSORS, *TORCH))
        raise CheckpointError(
            f"{path} has the suffix {suffix!r}; weights are read from files named {known}"
        )
    if tensors and all(name.startswith(DISTRIBUTED) for name in tensors):
        tensors = {name.removeprefix(DISTRIBUTED): tensor for name, tensor in tensors.items()}
        notes.append(f"took {DISTRIBUTED!r} off all {len(tensors)} names")
    return WeightFile(path, tensors, tuple(notes))


def _read_safetensors(path: Path) -> dict[str, Tensor]:
    if kind := pickle_kind(path):
        raise CheckpointError(
            f"{path} is {kind}, whatever its name says; if it holds weights, name it .pt: it is "
            "then read without running code in it"
        )
    with TensorFile(path) as file:
        if "qgs.recipe" in file.metadata:
            raise CheckpointError(f"{path} is a qgs checkpoint, no published weights")
        tensors = file.read()
    if not tensors:
        raise CheckpointError(f"{path} holds no tensors")
    return tensors


def _read_torch(path: Path, notes: list[str]) -> dict[str, Tensor]:
    kind = pickle_kind(path)
    with path.open("rb") as file:
        if file.read(9)[8:] == b"{":
            raise CheckpointError(f"{path} is a safetensors file; name it .safetensors")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True, mmap="zip" in kind)
    except Exception as error:  # whatever torch raises about a file that it cannot read
        reason = "it is cut off, or holds Python objects whose reading could run code"
        if type(error).__name__ != "UnpicklingError":
            reason = f"{type(error).__name__}: {str(error).strip().partition(chr(10))[0]}"
        raise CheckpointError(
            f"{path} is not a whole torch file of plain tensors ({reason}); copy it again, or save "
            "`model.state_dict()` alone"
        ) from error
    return _state_dict(content, path, notes)


def _state_dict(content: Any, path: Path, notes: list[str]) -> dict[str, Tensor]:
    """The tensors of a state dict, flat or below the keys in NESTING."""
    if not isinstance(content, Mapping) or not content:
        found = "nothing" if isinstance(content, Mapping) else type(content).__name__
        raise CheckpointError(f"{path} holds {found}, no state dict of names and tensors")
    others = [str(key) for key, value in content.items() if not isinstance(value, Tensor)]
    if not others:
        return {str(name): tensor.detach() for name, tensor in content.items()}
    inner = [key for key in NESTING if isinstance(content.get(key), Mapping)]
    if len(inner) != 1:
        among = f"more than one of them ({', '.join(inner)})" if inner else "none of them"
        raise CheckpointError(
            f"{path} holds entries that are no tensors ({listed(others)}); a state dict may lie "
            f"below {', '.join(NESTING)}, and {among} is a mapping here: save it alone"
        )
    left = [str(key) for key in content if key != inner[0]]
    beside = f", beside {listed(left)}, which are left out" if left else ""
    notes.append(f"the weights lie below {inner[0]!r}{beside}")
    return _state_dict(content[inner[0]], path, notes)
