"""Safetensors files: safe reading, even of hostile files, and atomic writing."""

import json
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from hashlib import blake2b
from pathlib import Path
from typing import Any, Self

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from qgs.files import AnyPath, replacing
from qgs.recipe import Recipe, RecipeError, resolve
from qgs.wording import name_shown

Weights = Mapping[str, Tensor]
"""Parameters and buffers of a model, by name."""
Shapes = Mapping[str, tuple[int, ...]]
"""Shapes of tensors by name."""
RECIPE = "qgs.recipe"
"""Name of the metadata entry with the complete recipe."""
SEAL = "qgs.seal"
"""Name of the metadata entry with the checksum of all other entries."""
_PICKLES = {b"PK\x03\x04": "a PyTorch (zip) file", b"\x80": "a Python pickle"}


class CheckpointError(ValueError):
    """Error for a file without usable weights. The message says what is wrong and how to fix it."""


class TensorFile:
    """Safetensors file that is open for reading, as a context manager.

    metadata: the text entries in the header of the file. Raises CheckpointError for a file that is
    incomplete or not a safetensors file, and passes on OSError and MemoryError. The library
    safetensors compares the sizes in the header with the size of the file before it maps the file
    into memory.
    """

    def __init__(self, path: AnyPath) -> None:
        self.path = Path(path)
        if not self.path.is_file():
            raise FileNotFoundError(f"no file at {self.path}")
        with self._whole():
            self._file: Any = safe_open(self.path, "pt")
        self.metadata: Mapping[str, str] = self._file.metadata() or {}
        if SEAL in self.metadata and self.metadata[SEAL] != seal(self.metadata):
            raise self.damaged("its metadata do not match their checksum")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self._file.__exit__(*exception)

    def read(self) -> dict[str, Tensor]:
        """Return all tensors by name, memory-mapped. They stay valid after the file is closed."""
        with self._whole():
            return {name: self._file.get_tensor(name) for name in self._file.keys()}  # noqa: SIM118

    @contextmanager
    def _whole(self) -> Iterator[None]:
        try:
            yield
        # A wrong header makes safetensors and torch raise anything.
        except Exception as error:
            # An error of the system, such as a failing disk, is no fault of the file.
            if isinstance(error, MemoryError) or getattr(error, "errno", None) is not None:
                raise
            if kind := pickle_kind(self.path):
                raise CheckpointError(
                    f"{self.path} is {kind}, which can run code when it is read. Use the "
                    "safetensors file of the run; convert published weights by `qgs import`, which "
                    "reads PyTorch files with the suffix .pt"
                ) from error
            raise CheckpointError(
                f"{self.path} is not a whole safetensors file ({name_shown(str(error))}); it may "
                "be cut off: copy it again"
            ) from error

    def damaged(self, what: str) -> CheckpointError:
        """Return the error for a damaged file. what: damaged part and reason, for the message."""
        return CheckpointError(
            f"{self.path} is damaged: {name_shown(what, 5000)}. Copy the file again from where it "
            "came, or take another checkpoint of the run"
        )

    @contextmanager
    def entry(self, key: str) -> Iterator[str]:
        """Yield the text of the metadata entry `key`.

        Errors in the body of the `with` statement become a CheckpointError for a damaged file.
        """
        try:
            yield self.metadata[key]
        except (RecipeError, CheckpointError):
            raise
        # Forged JSON makes later code raise anything.
        except Exception as error:
            what = f"`{key}` in its metadata cannot be read ({type(error).__name__}: {error})"
            raise self.damaged(what) from error

    def mapping(self, key: str) -> dict[str, Any]:
        """Return the JSON mapping in the metadata entry `key`.

        Raises CheckpointError if the entry is missing or is not a mapping.
        """
        with self.entry(key) as text:
            found = json.loads(text)
            if not isinstance(found, dict):
                raise TypeError(f"expected a mapping, got {type(found).__name__}")
            return found

    def stored_recipe(self) -> Recipe:
        """Return the complete recipe in the metadata entry RECIPE, without reading any other file.

        Raises CheckpointError for a damaged entry, and RecipeError if the installed components do
        not fit the recipe.
        """
        tree = self.mapping(RECIPE)
        if unresolved := [name for name in ("extends", "swap") if name in tree]:
            raise self.damaged(f"its recipe has `{unresolved[0]}`, which qgs never stores")
        with self.entry(RECIPE):
            return resolve(tree)


def write_tensors(path: AnyPath, tensors: Weights, metadata: Mapping[str, str]) -> None:
    """Write contiguous CPU `tensors` to `path`, atomically.

    Raises OSError if the file cannot be written.
    """
    with replacing(path) as temporary:
        try:
            save_file(dict(tensors), temporary, {**metadata, SEAL: seal(metadata)})
        except SafetensorError as error:
            # It gives the number of an OSError as text only.
            if number := re.search(r"os error (\d+)", str(error)):
                raise OSError(int(number[1]), str(error), os.fspath(path)) from error
            raise


def seal(metadata: Mapping[str, str]) -> str:
    """Return the checksum of all metadata entries except SEAL, the entry for this checksum."""
    entries = sorted((key, text) for key, text in metadata.items() if key != SEAL)
    return blake2b(json.dumps(entries).encode(), digest_size=16).hexdigest()


def pickle_kind(path: AnyPath) -> str:
    """Return the kind of a file that can run code when it is read; "" for any other file."""
    with open(path, "rb") as file:
        start = file.read(9)
    # safetensors begins with a length, whose bytes may look like a pickle, then JSON.
    if start[8:] == b"{":
        return ""
    return next((kind for magic, kind in _PICKLES.items() if start.startswith(magic)), "")


def inside(prefix: str, entries: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries whose names begin with `prefix`, by name without the prefix."""
    return {k.removeprefix(prefix): v for k, v in entries.items() if k.startswith(prefix)}


def copied(tensors: Weights) -> dict[str, Tensor]:
    """Return contiguous copies of `tensors` on the CPU, which share no memory."""
    return {
        name: tensor.detach().cpu().clone(memory_format=torch.contiguous_format)
        for name, tensor in tensors.items()
    }


def shapes_of(tensors: Weights) -> dict[str, tuple[int, ...]]:
    """Return the shapes of tensors by name."""
    return {name: tuple(tensor.shape) for name, tensor in tensors.items()}


def nonfinite(tensors: Weights) -> list[str]:
    """Return the names of tensors that hold NaN or infinity. All tensors must be on one device."""
    finite = {name: tensor.isfinite().all() for name, tensor in tensors.items()}
    # One read for all: each read would make the host wait for the device.
    flags = torch.stack([*finite.values()]).tolist() if finite else []
    return [name for name, is_finite in zip(finite, flags, strict=True) if not is_finite]


def differing_tensors(file: Shapes, recipe: Shapes) -> list[str]:
    """List differences in names and shapes between tensors of a file and of a recipe's model.

    Each difference is one line.
    """
    found = [f"missing: {name}" for name in recipe if name not in file]
    found += [f"unexpected: {name}" for name in file if name not in recipe]
    return found + [
        f"shape of {name}: {file[name]} in the file, {shape} in the recipe"
        for name, shape in recipe.items()
        if name in file and file[name] != shape
    ]


def differing_types(file: Weights, recipe: Weights) -> list[str]:
    """List differences in dtypes of the tensors that both a file and a recipe's model have.

    Each difference is one line. Half precision in the file and float32 in the model is not a
    difference.
    """
    allowed = {torch.float32: (torch.float32, torch.float16, torch.bfloat16)}
    return [
        f"type of {name}: {file[name].dtype} in the file, {tensor.dtype} in the recipe"
        for name, tensor in recipe.items()
        if name in file and file[name].dtype not in allowed.get(tensor.dtype, (tensor.dtype,))
    ]
