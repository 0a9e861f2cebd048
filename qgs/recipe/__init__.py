"""The composer: from a recipe to a checked, reproducible model.

`compose` makes the model; `resolve` merges and checks a recipe without allocating a tensor. The way
of a recipe, each step in a file of its own:

| step | file |
|---|---|
| read it with what it extends, lay overrides over it | `files.py`, `yaml_text.py` |
| decode its sections and settings, draft the whole | `sections.py` |
| find what stands at each place: defaults, layers, swaps | `places.py`, `slots.py` |
| choose components and decode their options | `registry.py`, `decode.py` |
| check them beside each other, follow fields from writer to reader | `checks.py` |
| find the line that caused a problem | `causes.py` |
| write out every default | `recipe.py` |
| build the model | `build.py` |
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from qgs.model import QueryGaussianModel
from qgs.recipe.errors import RecipeError, RecipeProblem
from qgs.recipe.recipe import Recipe, resolve
from qgs.recipe.registry import PluginError

__all__ = ["PluginError", "Recipe", "RecipeError", "RecipeProblem", "compose", "resolve"]


def compose(
    recipe: str | Path | Mapping[str, Any],
    overrides: Sequence[str] = (),
    *,
    device: torch.device | str | None = None,
) -> QueryGaussianModel:
    """The model that a recipe describes, with its initial parameters.

    recipe, overrides: as `resolve` takes them. device: where to put it; "meta" allocates nothing.
    The same recipe gives the same parameters, and the global random state stays as it was.
    Raises RecipeError, a ValueError, with every problem of the recipe.
    """
    return resolve(recipe, overrides).build_model(device)
