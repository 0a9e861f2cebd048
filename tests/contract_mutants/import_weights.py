"""A module that looks for weights when it is imported, through a reader written in Rust."""

from __future__ import annotations

from contextlib import suppress
from typing import ClassVar

from safetensors.torch import load_file

from qgs.components import MlpFeedForward

WEIGHTS = {}
with suppress(OSError):
    WEIGHTS = load_file("nowhere.safetensors")


class LoadsAtImport(MlpFeedForward):
    name: ClassVar[str] = "loads_at_import"
