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


def wrong_refusals(recipe, table):
    """Of overrides in a table, below each of which stands `option: reason`, those that are refused
    otherwise, and how."""
    wrong = []
    lines = table.split("\n")[1:-1]
    for override, expected in zip(lines[::2], lines[1::2], strict=True):
        option, _, reason = expected.strip().partition(":")
        problem = refused(recipe, [override])
        if problem.option != option or reason.strip() not in problem.reason:
            wrong.append((override, problem))
    return wrong
