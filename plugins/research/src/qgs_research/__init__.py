"""Studies, benchmarks, published weights."""

import os
from collections.abc import Sequence
from pathlib import Path


def short_names(recipes: Sequence[str | Path]) -> list[str]:
    """Names of recipes: what their folders share, and suffixes, left out."""
    files = [Path(recipe).absolute() for recipe in recipes]
    shared = os.path.commonpath([file.parent for file in files])
    return [os.path.relpath(file.with_suffix(""), shared) for file in files]
