"""Evaluation and training: the two modes in which a component is called."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

MODES = ("evaluation", "training")


def each_mode(module: Any) -> Iterator[str]:
    """The name of each mode, with `module` set to it."""
    for mode in MODES:
        module.train(mode == "training")
        yield mode
