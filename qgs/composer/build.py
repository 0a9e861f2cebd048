"""From chosen components to a model."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from qgs.composer.decode import Chosen
from qgs.composer.errors import RecipeError, RecipeProblem
from qgs.composer.flow import hold_to_promise
from qgs.composer.nodes import KeyPath
from qgs.composer.registry import BUILTIN, component_failure
from qgs.contracts import Component, ModelComponent, ModelDims, Optimizer, Refinement, SceneSource
from qgs.contracts.component import MissingExtraError
from qgs.model import DecoderLayer, QueryGaussianModel


def build(chosen: Chosen, dims: ModelDims) -> Any:
    """The component itself, built with the sizes of the model and held to what it provides."""
    if not issubclass(chosen.component, ModelComponent):
        return build_plain(chosen)
    built = _constructed(chosen, chosen.config, dims)
    hold_to_promise(built, chosen)
    return built


def build_plain(chosen: Chosen, *arguments: Any) -> Any:
    """A component that knows nothing of the model's sizes; arguments: for it besides its Config."""
    return _constructed(chosen, chosen.config, *arguments)


def _constructed(chosen: Chosen, *arguments: Any) -> Any:
    """An instance; what a plugin's constructor raises is reported with its distribution.

    Missing packages, data that cannot be opened and training that is too short for an optimiser
    are the user's to mend: told as they are.
    """
    make: Any = chosen.component
    try:
        built = make(*arguments)
    except MissingExtraError:
        raise
    except Exception as error:
        ours = chosen.installed.plugin.name == BUILTIN.name
        told = issubclass(make, SceneSource | Optimizer) and isinstance(error, ValueError | OSError)
        if ours or told:
            raise
        failure = component_failure(chosen.type, "__init__", error, chosen.installed)
        origin, path = chosen.place.origin, chosen.written_at
        problem = RecipeProblem(origin.file, origin.line, path, failure.reason, failure.fix)
        raise RecipeError([problem]) from error
    assert isinstance(built, Component)
    return built


def build_model(
    parts: Mapping[KeyPath, Chosen],
    dims: ModelDims,
    layer_scale: float,
    seed: int,
    tree: Mapping[str, Any],
    device: torch.device | str | None,
) -> QueryGaussianModel:
    """The model of a checked recipe.

    Parameters depend on the recipe alone: they are drawn on the CPU from `seed`, whatever the
    device, and the global random state stays as it was. On "meta" nothing is allocated.
    """
    on_meta = device is not None and torch.device(device).type == "meta"
    with torch.random.fork_rng(devices=()), torch.device("meta" if on_meta else "cpu"):
        torch.default_generator.manual_seed(seed)
        model = _assemble(parts, dims, layer_scale, tree)
    return model if on_meta or device is None else model.to(device)


def _assemble(
    parts: Mapping[KeyPath, Chosen], dims: ModelDims, layer_scale: float, tree: Mapping[str, Any]
) -> QueryGaussianModel:
    def at(*path: str) -> Any:
        return build(parts["model", *path], dims)

    encoder, queries = at("encoder"), at("queries")
    decoder, refinements, shared = [], [], {}
    for index in map(str, range(dims.depth)):
        layer = ("decoder", "layers", index)
        decoder.append(
            DecoderLayer(
                cross_attention=at(*layer, "cross_attention"),
                self_attention=at(*layer, "self_attention"),
                feed_forward=at(*layer, "feed_forward"),
                layer_scale=layer_scale,
            )
        )
        refinements.append(_shared_refinement(parts["model", *layer, "refinement"], dims, shared))
    return QueryGaussianModel(
        encoder=encoder,
        queries=queries,
        decoder=decoder,
        refinements=refinements,
        head=at("head"),
        centers=at("centers"),
        supervision=at("supervision"),
        renderer=at("renderer"),
        recipe=tree,
    )


def _shared_refinement(
    chosen: Chosen, dims: ModelDims, shared: dict[tuple[str, str], Refinement]
) -> Refinement:
    refinement = chosen.component
    assert issubclass(refinement, Refinement)
    if not refinement.shared_by_layers:
        return build(chosen, dims)
    key = (chosen.type, chosen.config.model_dump_json())
    if key not in shared:
        shared[key] = build(chosen, dims)
    return shared[key]
