"""A study as it runs: every variant composed, and all of them checked before anything trains."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from qgs.checkpoint.models import checkpoint_path
from qgs.cli.train import with_absolute_path
from qgs.recipe import Recipe, RecipeError, resolve
from qgs.recipe.errors import Origin, Problems
from qgs_research.studies.checks import check_data, check_distinct, check_equal, refuse_changed
from qgs_research.studies.runs import Plan, changed_recipe
from qgs_research.studies.study import Study


def planned(study: Study, folder: Path) -> Plan:
    """Compose all variants and check the study as a whole; nothing is written or trained.

    Raises as `composed`, what data sources raise, and ValueError where `folder` has runs of a
    variant, or results of an evaluation, that were another then.
    """
    plan = Plan(study, folder, composed(study))
    check_data(plan)
    refuse_changed(plan)
    return plan


def composed(study: Study) -> dict[str, Recipe]:
    """Return the recipes of all variants, with the study's budget.

    Raises RecipeError with all that is wrong with them and with what differs between them, and
    what building them raises.
    """
    problems = Problems("study")
    recipes: dict[str, Recipe] = {}
    for name, node in study.variants.items():
        with _collected(problems, f"variants.{name}", study.variants[name].origin):
            # A recipe has one seed; the runs set theirs over it.
            recipe = resolve(node, [f"seed={study.settings.seeds[0]}"])
            recipes[name] = _with_budget(study, with_absolute_path(recipe))
    # What differs from a variant that cannot be composed is not known.
    if len(recipes) == len(study.variants):
        check_equal(study, recipes, problems)
        check_distinct(study, recipes, problems)
        for label, node in study.evaluations.items():
            for name, recipe in recipes.items():
                with _collected(problems, f"evaluations.{label}, of {name}", node.origin):
                    changed_recipe(recipe, node)
    problems.raise_any()
    for name, recipe in recipes.items():
        try:
            _build(recipe)
        except (ValueError, OSError) as error:
            # What a component raises does not know in which variant it stands.
            error.add_note(f"in the variant `{name}`, {study.variants[name].origin}")
            raise
    return recipes


@contextmanager
def _collected(problems: Problems, place: str, origin: Origin) -> Iterator[None]:
    """Add what is wrong with a recipe to `problems`, instead of raising it."""
    try:
        yield
    except RecipeError as error:
        for found in error.problems:
            at = Origin(found.file, found.line) if found.line else origin
            problems.add(at, f"{place}: {found.option}", found.reason, found.fix, found.cause)


def _with_budget(study: Study, recipe: Recipe) -> Recipe:
    budget = study.settings.budget
    training = recipe.training
    if budget.seconds is not None:
        changes: dict[str, Any] = {"seconds": budget.seconds}
    else:
        steps = budget.steps
        if budget.images is not None:
            # Images that are rendered and judged, not those that are read.
            a_step = training.batch_size * recipe.views.targets
            steps = max(math.ceil(budget.images / a_step), 1)
        changes = {"steps": steps, "seconds": None}
    # Not an override: `qgs compose` shows who set the budget.
    tree = {**recipe.tree, "training": {**recipe.tree["training"], **changes}}
    origins = {f"training.{name}": "the study's budget" for name in changes}
    return replace(resolve(tree), provenance={**recipe.provenance, **origins})


def _build(recipe: Recipe) -> None:
    """Make every part of a variant, the model without memory, to see that they fit."""
    recipe.build_optimizer()
    # On the meta device: published models would not fit a laptop's memory.
    recipe.rate_factors(recipe.build_model("meta"))
    recipe.build_losses()
    recipe.build_objective()
    if recipe.init_from:
        checkpoint_path(recipe.init_from)
