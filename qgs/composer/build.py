"""From chosen components to a model."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from qgs.composer.decode import Chosen
from qgs.composer.nodes import Path
from qgs.contracts import Component, ModelComponent, ModelDims, Refinement
from qgs.model import DecoderLayer, QueryGaussianModel


def build(chosen: Chosen, dims: ModelDims) -> Any:
    """The component itself; one with parameters is given the sizes of the model."""
    if issubclass(chosen.component, ModelComponent):
        return chosen.component(chosen.config, dims)
    return build_plain(chosen)


def build_plain(chosen: Chosen) -> Any:
    """A component that knows nothing of the model's sizes."""
    plain: Any = chosen.component
    built = plain(chosen.config)
    assert isinstance(built, Component)
    return built


def build_model(
    parts: Mapping[Path, Chosen],
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
    parts: Mapping[Path, Chosen], dims: ModelDims, layer_scale: float, tree: Mapping[str, Any]
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
