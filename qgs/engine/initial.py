"""Starting from what another run has learned, with more or fewer queries."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

import torch
from safetensors import safe_open
from torch import Tensor

from qgs.composer import Recipe
from qgs.engine.folder import checkpoint_of
from qgs.io.checkpoint import CheckpointError, load_recipe, load_weights, unique_tensors
from qgs.io.differences import differing_tensors, options_beside_weights, shapes_of
from qgs.model import QueryGaussianModel

QUERIES = "queries."


def initialise(model: QueryGaussianModel, recipe: Recipe) -> list[str]:
    """Give `model`, freshly built from `recipe`, the weights that `recipe.init_from` names.

    `init_from` is a checkpoint or the folder of a run, relative to the working directory; without
    it the model stays as it is. Queries grow or shrink by their own rule (`Queries.resized`) with
    random numbers of the recipe's seed; everything else must have the same names and shapes.

    Returns what was done, line by line, with the options that make the same weights predict other
    Gaussians than where they were learned. Raises FileNotFoundError, and CheckpointError with every
    difference and with the options that would fit.
    """
    if recipe.init_from is None:
        return []
    path = checkpoint_of(Path(recipe.init_from).expanduser())
    learned_by = load_recipe(path)
    with safe_open(path, "pt") as file:
        learned = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    options = _differing_options(learned_by, recipe)
    found = _differences(learned, model, learned_by.build_model("meta").queries.count)
    if found:
        raise CheckpointError(_refusal(path, found, options))
    generator = torch.Generator().manual_seed(recipe.seed)
    queries = {k.removeprefix(QUERIES): v for k, v in learned.items() if k.startswith(QUERIES)}
    resized = model.queries.resized(queries, generator)
    weights = learned | {QUERIES + name: values for name, values in resized.items()}
    load_weights(model, weights, str(path))
    resizings = [
        _told(name, len(learned[name]), len(values))
        for name, values in weights.items()
        if values.shape != learned[name].shape
    ]
    others = [f"learned with {option}" for option in options]
    return [f"weights start from {path}", *resizings, *others]


def _told(name: str, old: int, new: int) -> str:
    if new < old:
        return f"{name}: {old} -> {new}, the first are kept"
    return f"{name}: {old} -> {new}, {old} kept, {new - old} noisy copies of them"


def _differences(learned: Mapping[str, Tensor], model: QueryGaussianModel, count: int) -> list[str]:
    """In what the weights of a model of `count` queries differ, besides that number."""
    own, theirs = shapes_of(unique_tensors(model)), shapes_of(learned)
    for name in own.keys() & theirs.keys():
        ours, shape = own[name], theirs[name]
        per_query = ours[:1] == (model.queries.count,) and shape[:1] == (count,)
        if name.startswith(QUERIES) and per_query and ours[1:] == shape[1:]:
            del own[name], theirs[name]
    return differing_tensors(theirs, own)


def _refusal(path: Path, found: Iterable[str], options: Iterable[str]) -> str:
    return "\n  ".join(
        [f"init_from: {path} does not fit this recipe; only the number of queries may differ:"]
        + [*found, "options of the model that the checkpoint was trained with:"]
        + [f"  {option}" for option in options]
    )


def _differing_options(learned_by: Recipe, recipe: Recipe) -> list[str]:
    """Options of the model, the number of queries aside, in which two recipes differ."""
    apart = options_beside_weights(learned_by.tree, recipe.tree)
    return [
        f"{path}: {theirs} (here {ours})"
        for path, (theirs, ours) in apart.items()
        if path != "model.queries.count"
    ]
