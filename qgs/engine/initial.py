"""Starting from what another run has learned, with more or fewer queries."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

import torch
from safetensors import safe_open
from torch import Tensor

from qgs.composer import Recipe
from qgs.composer.show import flat
from qgs.engine.folder import checkpoint_of
from qgs.io.checkpoint import CheckpointError, load_recipe, load_weights, unique_tensors
from qgs.model import QueryGaussianModel

QUERIES = "queries."


def initialise(model: QueryGaussianModel, recipe: Recipe) -> list[str]:
    """Give `model`, freshly built from `recipe`, the weights that `recipe.init_from` names.

    `init_from` is a checkpoint or the folder of a run, relative to the working directory; without
    it the model stays as it is. Queries grow or shrink by their own rule (`Queries.resized`) with
    random numbers of the recipe's seed; everything else must have the same names and shapes.

    Returns what was done, line by line. Raises FileNotFoundError, and CheckpointError with every
    difference and with the options that would fit.
    """
    if recipe.init_from is None:
        return []
    path = checkpoint_of(Path(recipe.init_from).expanduser())
    learned_by = load_recipe(path)
    with safe_open(path, "pt") as file:
        learned = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    found = _differences(learned, model, learned_by.build_model("meta").queries.count)
    if found:
        raise CheckpointError(_refusal(path, found, _differing_options(learned_by, recipe)))
    generator = torch.Generator().manual_seed(recipe.seed)
    queries = {k.removeprefix(QUERIES): v for k, v in learned.items() if k.startswith(QUERIES)}
    resized = model.queries.resized(queries, generator)
    weights = learned | {QUERIES + name: values for name, values in resized.items()}
    load_weights(model, weights, str(path))
    return [f"weights start from {path}"] + [
        _told(name, len(learned[name]), len(values))
        for name, values in weights.items()
        if values.shape != learned[name].shape
    ]


def _told(name: str, old: int, new: int) -> str:
    if new < old:
        return f"{name}: {old} -> {new}, the first are kept"
    return f"{name}: {old} -> {new}, {old} kept, {new - old} noisy copies of them"


def _differences(learned: Mapping[str, Tensor], model: QueryGaussianModel, count: int) -> list[str]:
    """In what the weights of a model of `count` queries differ, besides that number."""
    own = {name: tuple(tensor.shape) for name, tensor in unique_tensors(model).items()}
    theirs = {name: tuple(tensor.shape) for name, tensor in learned.items()}
    for name in own.keys() & theirs.keys():
        ours, shape = own[name], theirs[name]
        if (
            name.startswith(QUERIES)
            and ours[:1] == (model.queries.count,)
            and shape[:1] == (count,)
        ):
            theirs[name] = (*ours[:1], *shape[1:])
    found = [f"missing: {name}" for name in own if name not in theirs]
    found += [f"unexpected: {name}" for name in theirs if name not in own]
    return found + [
        f"shape of {name}: {tuple(learned[name].shape)} in the checkpoint, {shape} here"
        for name, shape in own.items()
        if name in theirs and theirs[name] != shape
    ]


def _refusal(path: Path, found: Iterable[str], options: Iterable[str]) -> str:
    return "\n  ".join(
        [f"init_from: {path} does not fit this recipe; only the number of queries may differ:"]
        + [*found, "options of the model that the checkpoint was trained with:"]
        + [f"  {option}" for option in options]
    )


def _differing_options(learned_by: Recipe, recipe: Recipe) -> list[str]:
    """Options of the model, the number of queries aside, in which two recipes differ."""
    theirs, ours = flat(learned_by.tree["model"]), flat(recipe.tree["model"])
    return [
        f"model.{path}: {theirs.get(path, 'none')} (here {ours.get(path, 'none')})"
        for path in dict.fromkeys([*theirs, *ours])
        if theirs.get(path) != ours.get(path) and path != "queries.count"
    ]
