"""Tools for research: studies, benchmarks, and import of published weights."""

import os
from collections.abc import Sequence
from pathlib import Path


def short_names(recipes: Sequence[str | Path]) -> list[str]:
    """Return the paths of recipes without suffixes, relative to the folder that holds them all."""
    files = [Path(recipe).absolute() for recipe in recipes]
    shared = os.path.commonpath([file.parent for file in files])
    return [os.path.relpath(file.with_suffix(""), shared) for file in files]
