"""`init_from`: a training that starts from the weights of another one."""

from collections.abc import Mapping

import torch
from torch import Tensor

from qgs.composer import Recipe
from qgs.engine.folder import checkpoint_of
from qgs.io.checkpoint import (
    CheckpointError,
    load_recipe,
    load_weights,
    read_tensors,
    refuse_damaged,
    unique_tensors,
)
from qgs.io.differences import differing_tensors, options_beside_weights, shapes_of
from qgs.model import QueryGaussianModel

_QUERIES, _ENCODER = "queries.", "encoder."


def initialise(model: QueryGaussianModel, recipe: Recipe) -> list[str]:
    """Give `model`, freshly built from `recipe`, the weights that `recipe.init_from` names, if any.

    `init_from` is a checkpoint, the folder of a run, a shipped model or a URL. Queries
    grow or shrink by their own rule (`Queries.resized`) with random numbers of the recipe's seed,
    the encoder adapts weights to its patches (`Encoder.adapted`); everything else must have the
    same names and shapes.

    Returns what was done, line by line, with the options that make the same weights predict other
    Gaussians. Raises FileNotFoundError, CheckpointError with every difference and what would fit.
    """
    if recipe.init_from is None:
        return []
    path = checkpoint_of(recipe.init_from)
    learned_by = load_recipe(path)
    stored = read_tensors(path)
    learned = {n: t.float() if t.is_floating_point() else t for n, t in stored.items()}
    options = [
        f"{option}: {theirs} (here {ours})"
        for option, (theirs, ours) in options_beside_weights(learned_by.tree, recipe.tree).items()
        if option != "model.queries.count"
    ]
    adapted = model.encoder.adapted(_of(_ENCODER, learned))
    weights = learned | {_ENCODER + name: values for name, values in adapted.items()}
    found = _differences(weights, model, learned_by.build_model("meta").queries.count)
    if found:
        first = (
            f"init_from: {path} does not fit this recipe; only the number of queries and, to a "
            "multiple, the size of patches may differ:"
        )
        trained = "options of the model that the checkpoint was trained with:"
        raise CheckpointError("\n  ".join([first, *found, trained, *(f"  {o}" for o in options)]))
    generator = torch.Generator().manual_seed(recipe.seed)
    resized = model.queries.resized(_of(_QUERIES, learned), generator)
    weights |= {_QUERIES + name: values for name, values in resized.items()}
    load_weights(model, weights, str(path))
    refuse_damaged(stored, path)
    changes = [
        _change(name, learned[name], values)
        for name, values in weights.items()
        if values.shape != learned[name].shape
    ]
    learned_with = [f"learned with {option}" for option in options]
    return [f"weights start from {path}", *changes, *learned_with]


def _of(part: str, learned: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The weights of one part of the model, by their names in it."""
    return {k.removeprefix(part): v for k, v in learned.items() if k.startswith(part)}


def _change(name: str, old: Tensor, new: Tensor) -> str:
    """In words, how a weight was brought to another shape."""
    if not name.startswith(_QUERIES):
        return f"{name}: {tuple(old.shape)} -> {tuple(new.shape)}"
    before, after = len(old), len(new)
    kept = f"{before} kept, {after - before} noisy copies of them"
    return f"{name}: {before} -> {after}, {'the first are kept' if after < before else kept}"


def _differences(
    learned: Mapping[str, Tensor], model: QueryGaussianModel, count: int | None
) -> list[str]:
    """In what the weights of a model of `count` queries differ, besides that number."""
    own, theirs = shapes_of(unique_tensors(model)), shapes_of(learned)
    for name in own.keys() & theirs.keys():
        ours, shape = own[name], theirs[name]
        per_query = ours[:1] == (model.queries.count,) and shape[:1] == (count,)
        if name.startswith(_QUERIES) and per_query and ours[1:] == shape[1:]:
            del own[name], theirs[name]
    return differing_tensors(theirs, own)
