"""The composer: from a recipe to a checked, reproducible model.

`compose` makes the model. `resolve` merges and checks a recipe without allocating a tensor. A
recipe passes through these steps, each in a file of its own:

| step | file |
|---|---|
| read it and the recipes that it extends, apply overrides | `files.py`, `yaml_text.py` |
| decode its sections and settings, make a draft | `sections.py` |
| find the component at each place: defaults, layers, swaps | `places.py`, `slots.py` |
| choose components and decode their options | `registry.py`, `decode.py` |
| check them together, follow fields from writer to reader | `checks.py` |
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
    """Build the model that a recipe describes, with its initial parameters.

    recipe, overrides: see `resolve`. device: device of the model; "meta" allocates nothing.
    The same recipe gives the same parameters. The global random state does not change.
    Raises RecipeError, a ValueError, with every problem of the recipe.
    """
    return resolve(recipe, overrides).build_model(device)
