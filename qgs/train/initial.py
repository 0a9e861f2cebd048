"""Option `init_from`: training that starts from the weights of another training."""

import torch
from torch import Tensor

from qgs.checkpoint.model_file import CheckpointFile, load_weights, unique_tensors
from qgs.checkpoint.tensors import (
    CheckpointError,
    Shapes,
    Weights,
    differing_tensors,
    shapes_of,
)
from qgs.model import QueryGaussianModel
from qgs.recipe import Recipe
from qgs.recipe.recipe import differing_predictions

_QUERIES = "queries."
_KEPT = ", the first ones are kept, additional ones are noisy copies"


def initialise(model: QueryGaussianModel, recipe: Recipe) -> list[str]:
    """Give `model`, freshly built from `recipe`, the weights of `recipe.init_from`, if any.

    `init_from` is a name that `CheckpointFile` accepts. Queries grow or shrink by `Queries.resized`
    with random numbers from the recipe's seed. Encoder, feedback and head adapt their weights with
    `ModelComponent.adapted`. All other weights must have the same names and shapes.

    Returns lines that list resized weights, new weights, and options that change the Gaussians
    predicted from the same weights. Raises FileNotFoundError, or CheckpointError with all
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
        adapted = getattr(model, part).adapted(_part(f"{part}.", learned))
        weights |= {f"{part}.{name}": values.cpu() for name, values in adapted.items()}
    own = _comparable(unique_tensors(model), model.queries.count)
    if found := differing_tensors(_comparable(weights, count), own):
        first = (
            f"init_from: {path} does not fit this recipe; only the number of queries, sizes that "
            "encoder and head can adapt (of patches, to a multiple) and new feedback may differ:"
        )
        trained = "options of the checkpoint's model that differ:"
        raise CheckpointError("\n  ".join([first, *found, trained, *(f"  {o}" for o in options)]))
    generator = torch.Generator().manual_seed(recipe.seed)
    resized = model.queries.resized(_part(_QUERIES, learned), generator)
    weights |= {_QUERIES + name: values for name, values in resized.items()}
    load_weights(model, weights, path)
    before = shapes_of(learned)
    changes = [
        f"{name}: {before.get(name, 'none')} -> {shape}"
        + (_KEPT if name.startswith(_QUERIES) and name in before else "")
        for name, shape in shapes_of(weights).items()
        if shape != before.get(name)
    ]
    return [f"weights start from {path}", *changes, *(f"learned with {o}" for o in options)]


def _part(prefix: str, weights: Weights) -> dict[str, Tensor]:
    """Return the weights of one part of the model, by their names inside that part."""
    return {k.removeprefix(prefix): v for k, v in weights.items() if k.startswith(prefix)}


def _comparable(tensors: Weights, count: int | None) -> Shapes:
    """Return shapes by name, with -1 for the number of queries `count`, which may differ."""
    return {
        name: (-1, *shape[1:]) if name.startswith(_QUERIES) and shape[:1] == (count,) else shape
        for name, shape in shapes_of(tensors).items()
    }
