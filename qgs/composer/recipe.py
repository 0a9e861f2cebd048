"""Resolving a recipe: everything that can be said about it before a tensor is allocated."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import Any

import torch

from qgs.composer.build import build_model, build_plain
from qgs.composer.declared import check_declarations
from qgs.composer.decode import Chosen, decode_places
from qgs.composer.errors import Problems
from qgs.composer.files import read_recipe
from qgs.composer.flow import check_flow, decoded_layers, execution_order
from qgs.composer.nodes import MapNode, Origin, Path, from_plain, locate
from qgs.composer.overrides import apply_overrides
from qgs.composer.places import expand
from qgs.composer.registry import PluginError, Registry
from qgs.composer.resolved import Resolution
from qgs.composer.sections import Settings, check_tree, decode_settings, load_plugins
from qgs.composer.slots import DEFAULT_LOSSES
from qgs.composer.swap import apply_swaps
from qgs.contracts import (
    EvaluationConfig,
    Loss,
    ModelDims,
    Plugin,
    RecipeContext,
    SceneSource,
    SceneSourceConfig,
    TrainingConfig,
    ViewsConfig,
)
from qgs.model import QueryGaussianModel


@dataclass(frozen=True)
class Recipe:
    """A recipe that has passed every check.

    tree: plain mapping, every default spelled out; resolving it again gives the same.
    provenance: dotted path of each value of `tree` to the place that set it.
    parts: path of each place, decoder layers numbered, to the component that stands there.
    plugin_versions: name to version of every plugin in use, `qgs` included.
    """

    tree: Mapping[str, Any]
    provenance: Mapping[str, str]
    parts: Mapping[Path, Chosen]
    dims: ModelDims
    layer_scale: float
    seed: int
    init_from: str | None
    views: ViewsConfig
    training: TrainingConfig
    evaluation: EvaluationConfig
    plugin_versions: Mapping[str, str]

    def build_model(self, device: torch.device | str | None = None) -> QueryGaussianModel:
        """The model with its initial parameters; on "meta" it takes no memory."""
        return build_model(self.parts, self.dims, self.layer_scale, self.seed, self.tree, device)

    def build_losses(self) -> dict[str, Loss]:
        """Losses by the names that the recipe gives them.

        `losses: {}` gives none: fine for everything but training, which refuses it.
        """
        return {
            path[1]: build_plain(chosen)
            for path, chosen in self.parts.items()
            if path[0] == "losses"
        }

    def build_data(self) -> SceneSource:
        """The source of scenes; raises ValueError for a recipe without data."""
        if ("data",) not in self.parts:
            raise ValueError("this recipe has no data; add `data: {type: PLUGIN/NAME}`")
        return build_plain(self.parts["data",])


def resolve(
    recipe: str | FilePath | Mapping[str, Any],
    overrides: Sequence[str] = (),
    plugins: Sequence[Plugin] = (),
) -> Recipe:
    """Read, merge and check a recipe.

    recipe: path of a YAML file, or a mapping of the same form, whose `extends` is relative to the
        working directory. overrides: `a.b=value`, laid over it in order.
    plugins: what the recipe may name besides the plugins that are installed, such as one under
        test.
    Raises RecipeError with every problem that was found.
    """
    problems = Problems()
    tree = apply_overrides(read_recipe(recipe, problems), overrides, problems)
    tree = check_tree(tree, problems)
    problems.raise_if_stopped()
    tree = _with_default_losses(tree)
    settings = decode_settings(tree, problems)
    registry = load_plugins(tree, problems, plugins)
    places = expand(tree, settings.decoder.depth, problems)
    places = apply_swaps(tree.child_map("swap"), places, problems)
    parts = decode_places(places, registry, problems)
    _check_components(parts, settings, registry, problems)
    problems.raise_any()
    return _finish(tree, settings, registry, parts)


def _with_default_losses(tree: MapNode) -> MapNode:
    if "losses" in tree.items:
        return tree
    origin = Origin("default")
    losses = {name: {"type": kind} for name, kind in DEFAULT_LOSSES.items()}
    return tree.with_item("losses", from_plain(losses, origin), origin)


def _check_components(
    parts: Mapping[Path, Chosen | None], settings: Settings, registry: Registry, problems: Problems
) -> None:
    """Check components against the rest of the recipe, as far as that could be decoded."""
    if not settings.sizes_known:
        return
    depth = settings.decoder.depth
    dims = ModelDims(settings.model.width, settings.model.heads, depth)
    data = parts.get(("data",))
    source = data.config if data else None
    size = source.image_size if isinstance(source, SceneSourceConfig) else None
    context = RecipeContext(dims, size)
    parts = {
        path: chosen if chosen and _check_options(chosen, context, problems) else None
        for path, chosen in parts.items()
    }
    decoded = decoded_layers(parts["model", "supervision"], depth)
    check_flow(list(execution_order(parts, depth, decoded)), registry, problems)


def _check_options(chosen: Chosen, context: RecipeContext, problems: Problems) -> bool:
    """Report what is wrong with a component's options; whether the component could be asked."""
    try:
        found = check_declarations(chosen, context)
    except PluginError as error:
        problems.add(chosen.place.origin, chosen.written_at, error.reason, error.fix, error)
        return False
    for problem in found:
        steps = problem.option.split(".") if problem.option else []
        node = chosen.place.node
        origin = chosen.place.origin
        if isinstance(node, MapNode) and steps and steps[0] in node.items:
            origin = locate(node, steps)
        path = ".".join([chosen.written_at, *steps])
        problems.add(origin, path, problem.reason, problem.fix)
    return True


def _finish(
    tree: MapNode,
    settings: Settings,
    registry: Registry,
    parts: Mapping[Path, Chosen | None],
) -> Recipe:
    chosen = {path: part for path, part in parts.items() if part is not None}
    resolution = Resolution(tree, settings, registry, chosen)
    model, decoder = settings.model, settings.decoder
    return Recipe(
        tree=resolution.tree,
        provenance=resolution.provenance,
        parts=chosen,
        dims=ModelDims(model.width, model.heads, decoder.depth),
        layer_scale=decoder.layer_scale,
        seed=settings.recipe.seed,
        init_from=settings.recipe.init_from,
        views=settings.views,
        training=settings.training,
        evaluation=settings.evaluation,
        plugin_versions={name: plugin.version for name, plugin in registry.plugins.items()},
    )
