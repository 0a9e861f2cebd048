"""Option `init_from` of a recipe: training starts from the weights of a checkpoint."""

import torch

from qgs.checkpoint.model_file import CheckpointFile, load_weights, unique_tensors
from qgs.checkpoint.tensors import (
    CheckpointError,
    Shapes,
    Weights,
    differing_tensors,
    inside,
    shapes_of,
)
from qgs.model import QueryGaussianModel
from qgs.recipe import Recipe
from qgs.recipe.recipe import differing_predictions

_QUERIES = "queries."
_KEPT = ": the first queries are kept, additional queries are noisy copies"


def initialise(model: QueryGaussianModel, recipe: Recipe) -> list[str]:
    """Load the weights of the checkpoint `recipe.init_from` into `model`; if null, do nothing.

    model: newly built from `recipe`. The number of queries is adapted by `Queries.resized`, with
        random numbers from the recipe's seed. Encoder, feedback and head adapt their weights with
        `ModelComponent.adapted`. All other weights must have the same names and shapes.

    Returns lines for the user: resized weights, new weights, and differing options of the two
    recipes that change the predictions. Raises FileNotFoundError, or CheckpointError that lists all
    differences.
    """
    if recipe.init_from is None:
        return []
    with CheckpointFile(recipe.init_from) as file:
        path = file.path
        stored = file.tensors
        differing = differing_predictions(file.recipe.tree, recipe.tree)
        count = file.untrained("meta").queries.count
    # Checkpoints may hold half precision; training takes float32.
    learned = {n: t.float() if t.is_floating_point() else t for n, t in stored.items()}
    options = [
        f"{option}: {theirs} (here {ours})"
        for option, (theirs, ours) in differing.items()
        if option != "model.queries.count"
    ]
    weights = dict(learned)
    for part in ("encoder", "feedback", "head"):
        adapted = getattr(model, part).adapted(inside(f"{part}.", learned))
        weights |= {f"{part}.{name}": values.cpu() for name, values in adapted.items()}
    own = unique_tensors(model)
    # Feedback of another kind is left out.
    weights = {n: t for n, t in weights.items() if n in own or not n.startswith("feedback.")}
    comparable = _comparable(own, model.queries.count)
    if found := differing_tensors(_comparable(weights, count), comparable):
        first = (
            f"init_from: {path} does not fit this recipe. Only the number of queries, the patch "
            "size (to a multiple), sizes that the head can adapt, and the feedback may differ:"
        )
        trained = "options of the checkpoint's recipe that differ:"
        raise CheckpointError("\n  ".join([first, *found, trained, *(f"  {o}" for o in options)]))
    generator = torch.Generator().manual_seed(recipe.seed)
    resized = model.queries.resized(inside(_QUERIES, learned), generator)
    weights |= {_QUERIES + name: values for name, values in resized.items()}
    load_weights(model, weights, path)
    before = shapes_of(learned)
    after = shapes_of(weights)
    changes = [
        f"{name}: {before.get(name, 'none')} -> {after.get(name, 'none')}"
        + (_KEPT if name.startswith(_QUERIES) and name in before else "")
        for name in before | after
        if before.get(name) != after.get(name)
    ]
    return [f"weights start from {path}", *changes, *(f"trained with {o}" for o in options)]


def _comparable(tensors: Weights, count: int | None) -> Shapes:
    """Return the shape of each tensor, with -1 in place of the number of queries, `count`."""
    return {
        name: (-1, *shape[1:]) if name.startswith(_QUERIES) and shape[:1] == (count,) else shape
        for name, shape in shapes_of(tensors).items()
    }
