"""What a recipe that is refused is refused for."""

from collections.abc import Callable
from typing import Any

import pytest

from qgs.composer import RecipeError, RecipeProblem, resolve


def refused(recipe: Any, *arguments: Any, by: Callable = resolve, **options: Any) -> RecipeProblem:
    """The one problem of a recipe that `by`, called with these arguments, refuses."""
    with pytest.raises(RecipeError) as caught:
        by(recipe, *arguments, **options)
    (problem,) = caught.value.problems
    return problem
