"""Published weights to import: those of the golden files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from safetensors import safe_open
from torch import Tensor

GOLDEN = Path(__file__).parents[1] / "golden"
PREFIX = "weights."


@pytest.fixture(scope="session")
def published() -> Callable[[str], dict[str, Tensor]]:
    """`published("locus_full_a")`: the state dict in a golden file, a new mapping each time."""

    def read(name: str) -> dict[str, Tensor]:
        with safe_open(GOLDEN / f"{name}.safetensors", "pt") as file:
            names = [name for name in file.keys() if name.startswith(PREFIX)]  # noqa: SIM118
            return {name.removeprefix(PREFIX): file.get_tensor(name) for name in names}

    return read
