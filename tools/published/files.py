"""A file of golden numbers: tensors, and in its metadata what they were computed with."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from safetensors import safe_open
from torch import Tensor

WEIGHTS = "weights."
EXPECTED = "expected."
LOADER = ("crop.", "patch.")
"""Prefixes of a release's data loader.

They are not read: it crops photos to whole pixels, sources here do not.
"""


@dataclass
class GoldenFile:
    """tensors: by name. config: the JSON in the metadata. read: names given out as inputs."""

    tensors: dict[str, Tensor]
    config: dict[str, Any]
    read: set[str] = field(default_factory=set)

    @property
    def is_of_losses(self) -> bool:
        """True for a file of loss terms, false for tensors of a model."""
        return any(name.startswith(EXPECTED) for name in self.tensors)

    def input(self, name: str) -> Tensor:
        """Return a tensor to compute from, in float32."""
        self.read.add(name)
        tensor = self.tensors[name]
        return tensor.float() if tensor.is_floating_point() else tensor

    def weights(self) -> dict[str, Tensor]:
        """Return the published state dict."""
        names = [name for name in self.tensors if name.startswith(WEIGHTS)]
        return {name.removeprefix(WEIGHTS): self.input(name) for name in names}

    def expected(self) -> dict[str, Tensor]:
        """Return the tensors to compare: all but inputs and weights."""
        return {name: value for name, value in self.tensors.items() if name not in self.read}

    def promised(self) -> list[str]:
        """Names that the metadata lists as outputs."""
        return [name for name in self.config.get("outputs", []) if not name.startswith(LOADER)]


def read_golden(path: Path) -> GoldenFile:
    """Read a file."""
    with safe_open(path, "pt") as file:
        names = [name for name in list(file.keys()) if not name.startswith(LOADER)]
        tensors = {name: file.get_tensor(name) for name in names}
        return GoldenFile(tensors, json.loads(file.metadata()["config"]))
