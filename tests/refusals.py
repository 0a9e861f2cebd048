"""What a recipe that is refused is refused for."""

from collections.abc import Callable
from typing import Any

from qgs.composer import RecipeError, RecipeProblem, resolve


def problems_of(
    recipe: Any, *arguments: Any, by: Callable = resolve, **options: Any
) -> tuple[RecipeProblem, ...]:
    """All problems for which `by`, called with these arguments, refuses a recipe."""
    try:
        by(recipe, *arguments, **options)
    except RecipeError as error:
        return error.problems
    return ()


def refused(recipe: Any, *arguments: Any, **options: Any) -> RecipeProblem:
    """The one problem."""
    (problem,) = problems_of(recipe, *arguments, **options)
    return problem
