"""What a recipe that is refused is refused for."""

from qgs.recipe import RecipeError, resolve


def problems_of(recipe, *arguments, by=resolve, **options):
    """All problems for which `by`, called with these arguments, refuses a recipe."""
    try:
        by(recipe, *arguments, **options)
    except RecipeError as error:
        return error.problems
    return ()


def refused(recipe, *arguments, **options):
    """The one problem."""
    (problem,) = problems_of(recipe, *arguments, **options)
    return problem
