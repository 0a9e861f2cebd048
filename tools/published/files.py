"""A file of golden numbers: tensors, and in its metadata what they were computed with."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from torch import Tensor

from qgs.contracts.released import ReleasedOptions

WEIGHTS = "weights."
EXPECTED = "expected."


class GoldenFileError(ValueError):
    """A file that cannot be compared with; the message says what is missing or contradictory."""


@dataclass
class GoldenFile:
    """tensors: by name. config: the JSON in the metadata. read: names given out as inputs."""

    tensors: dict[str, Tensor]
    config: dict[str, Any]
    read: set[str] = field(default_factory=set)

    @property
    def size(self) -> tuple[int, int]:
        """(H, W) of the images, in pixels."""
        options = self.config.get("options", self.config)
        if "img_size" not in options:
            raise GoldenFileError("img_size is missing in the metadata")
        height, width = options["img_size"]
        return height, width

    def released(self, group: str) -> ReleasedOptions:
        """The published options in the metadata under `group`."""
        if group not in self.config:
            raise GoldenFileError(f"the metadata has no `{group}`")
        return ReleasedOptions(self.config[group])

    @property
    def is_of_losses(self) -> bool:
        """Whether it holds loss terms; else the inside of a model."""
        return any(name.startswith(EXPECTED) for name in self.tensors)

    def input(self, name: str) -> Tensor:
        """A tensor to compute from, which is not compared; raises GoldenFileError without it."""
        if name not in self.tensors:
            raise GoldenFileError(f"the input `{name}` is missing")
        self.read.add(name)
        return self.tensors[name]

    def weights(self) -> dict[str, Tensor]:
        """The published state dict."""
        names = [name for name in self.tensors if name.startswith(WEIGHTS)]
        return {name.removeprefix(WEIGHTS): self.input(name) for name in names}

    def expected(self) -> dict[str, Tensor]:
        """Whatever is neither an input nor a weight: to be compared, every one."""
        return {name: value for name, value in self.tensors.items() if name not in self.read}

    def promised(self) -> list[str]:
        """Names that the metadata lists as outputs."""
        return self.config.get("outputs", [])


def read_golden(path: Path) -> GoldenFile:
    """Read a file; raises GoldenFileError for one that is unreadable or without metadata."""
    try:
        with safe_open(path, "pt") as file:
            names = list(file.keys())
            tensors = {name: file.get_tensor(name) for name in names}
            metadata = file.metadata() or {}
    except (OSError, SafetensorError) as error:
        raise GoldenFileError(f"not a readable safetensors file: {error}") from error
    if "config" not in metadata:
        raise GoldenFileError("the metadata has no `config`, which says how to compose the model")
    return GoldenFile(tensors, json.loads(metadata["config"]))
