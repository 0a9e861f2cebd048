"""Golden files: tensors computed by the published code, with its options in the metadata."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torch import Tensor

from qgs.checkpoint.tensors import TensorFile, inside

Tensors = dict[str, Tensor]
"""Tensors by name."""

WEIGHTS = "weights."
LOADER = ("crop.", "patch.")
"""Prefixes of tensors of the published data loader.

They are not compared: it crops photos to whole pixels, and data sources of qgs do not.
"""


@dataclass
class GoldenFile:
    """Content of a golden file.

    tensors: tensors by name. config: JSON in the metadata. read: names of tensors that were used as
    inputs, so they are not compared.
    """

    tensors: Tensors
    config: dict[str, Any]
    read: set[str] = field(default_factory=set)

    def input(self, name: str) -> Tensor:
        """Return an input tensor in float32, and note that it was used."""
        self.read.add(name)
        tensor = self.tensors[name]
        return tensor.float() if tensor.is_floating_point() else tensor

    def weights(self) -> Tensors:
        """Return the published state dict in the file."""
        return {name: self.input(f"{WEIGHTS}{name}") for name in inside(WEIGHTS, self.tensors)}

    def expected(self) -> Tensors:
        """Return the tensors to compare: all except inputs and weights."""
        return {name: value for name, value in self.tensors.items() if name not in self.read}

    def promised(self) -> list[str]:
        """Return the names that the metadata lists as outputs."""
        return [name for name in self.config.get("outputs", []) if not name.startswith(LOADER)]


def read_golden(path: Path) -> GoldenFile:
    """Read a golden file."""
    with TensorFile(path) as file:
        tensors = {name: x for name, x in file.read().items() if not name.startswith(LOADER)}
        return GoldenFile(tensors, file.mapping("config"))
