"""The composer: it turns a recipe into a checked, reproducible model.

`compose` builds the model. `resolve` merges and checks a recipe without allocating a tensor. A
recipe passes through these steps, each in its own file:

| step | file |
|---|---|
| read the recipe and those that it extends, apply overrides | `files.py`, `yaml_text.py` |
| decode sections and settings | `sections.py` |
| find the entry of each component, after defaults and section `swap` | `places.py`, `slots.py` |
| find the class of each component and decode its options | `registry.py`, `decode.py` |
| check that components fit, and that each field is written before it is read | `checks.py` |
| find the line of the recipe that caused a problem | `causes.py` |
| write out the default of every option | `recipe.py` |
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

    recipe: path of a YAML file, name of a recipe that comes with qgs (tiny/locus.yaml), or mapping.
    overrides: changes such as "model.queries.count=128", applied in order.
    device: device of the model; None means the CPU, and "meta" allocates no memory.
    The same recipe gives the same parameters. The global random state does not change.
    Raises RecipeError (a ValueError) that lists all problems of the recipe.
    """
    return resolve(recipe, overrides).build_model(device)
