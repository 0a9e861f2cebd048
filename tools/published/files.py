"""A file of golden numbers: tensors, and in its metadata what they were computed with."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from torch import Tensor

WEIGHTS = "weights."
EXPECTED = "expected."
LOADER = ("crop.", "patch.")
"""Of a release's data loader: it crops photos to whole pixels, the sources here do not."""


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
        options = self.options("options") if "options" in self.config else self.config
        size = options.get("img_size")
        if not isinstance(size, list) or [type(side) for side in size] != [int, int]:
            raise GoldenFileError(f"img_size must be [height, width] in pixels, got {size!r}")
        return size[0], size[1]

    def options(self, group: str, beside: Mapping[str, Any] | None = None) -> Mapping[str, Any]:
        """Return the published options under `group`, and `beside`.

        Raises GoldenFileError if the metadata has no such group of options.
        """
        if group not in self.config:
            raise GoldenFileError(f"the metadata has no `{group}`")
        options = self.config[group]
        if not isinstance(options, dict):
            raise GoldenFileError(f"`{group}` must be a mapping of options, got {options!r}")
        return {**options, **(beside or {})}

    @property
    def is_of_losses(self) -> bool:
        """Whether it holds loss terms, rather than tensors of a model."""
        return any(name.startswith(EXPECTED) for name in self.tensors)

    def input(self, name: str) -> Tensor:
        """A tensor to compute from, in float32; raises GoldenFileError without it."""
        if name not in self.tensors:
            raise GoldenFileError(f"the input `{name}` is missing")
        self.read.add(name)
        tensor = self.tensors[name]
        return tensor.float() if tensor.is_floating_point() else tensor

    def weights(self) -> dict[str, Tensor]:
        """The published state dict."""
        names = [name for name in self.tensors if name.startswith(WEIGHTS)]
        return {name.removeprefix(WEIGHTS): self.input(name) for name in names}

    def expected(self) -> dict[str, Tensor]:
        """The tensors to compare: all but inputs, weights and those of a data loader."""
        left_out = {*self.read, *self.of_loader()}
        return {name: value for name, value in self.tensors.items() if name not in left_out}

    def of_loader(self) -> list[str]:
        """Names of a data loader's tensors."""
        return [name for name in self.tensors if name.startswith(LOADER)]

    def promised(self) -> list[str]:
        """Names that the metadata lists as outputs."""
        outputs = self.config.get("outputs", [])
        if not isinstance(outputs, list) or not all(isinstance(name, str) for name in outputs):
            raise GoldenFileError(f"`outputs` must be a list of names, got {outputs!r}")
        return [name for name in outputs if not name.startswith(LOADER)]


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
    config = json.loads(metadata["config"])
    if not isinstance(config, dict):
        raise GoldenFileError(f"`config` in the metadata must be a mapping, got {config!r}")
    return GoldenFile(tensors, config)
