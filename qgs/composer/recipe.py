"""Resolving a recipe: everything that can be said about it before a tensor is allocated."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from qgs.composer.build import build_model, build_plain
from qgs.composer.decode import Chosen, decode_places
from qgs.composer.errors import Problems
from qgs.composer.files import apply_overrides, merge, read_recipe
from qgs.composer.flow import check_declarations, check_flow, decoded_layers, execution_order
from qgs.composer.nodes import KeyPath, MapNode, Node, Origin, from_plain, locate
from qgs.composer.places import apply_swaps, expand
from qgs.composer.registry import PluginError, Registry
from qgs.composer.sections import Settings, check_tree, decode_settings, load_plugins
from qgs.composer.slots import LAYER_SLOTS, MODEL_SLOTS, SECTIONS
from qgs.composer.yaml_text import dump
from qgs.contracts import (
    ComponentConfig,
    EvaluationConfig,
    Loss,
    Metric,
    ModelDims,
    Optimizer,
    Plugin,
    RecipeContext,
    SceneSource,
    SceneSourceConfig,
    TrainingConfig,
    ViewsConfig,
)
from qgs.model import QueryGaussianModel


class Resolution:
    """Builds the resolved tree and its provenance side by side.

    tree: plain values, composing it again gives the same tree. provenance: dotted path of each
    value to `FILE:LINE`, `--set #n`, or the default that set it.
    """

    def __init__(
        self,
        source: MapNode,
        settings: Settings,
        registry: Registry,
        parts: Mapping[KeyPath, Chosen],
    ) -> None:
        self.source = source
        self.parts = parts
        self.tree: dict[str, Any] = {}
        self.provenance: dict[str, str] = {}
        self._put_settings((), settings.recipe)
        names = [name for name in registry.plugins if name != "qgs"]
        self._put(("plugins",), names, self._written(("plugins",)))
        self._put_settings(("model",), settings.model)
        for name in MODEL_SLOTS[:2]:
            self._put_component(("model", name))
        self._put_settings(("model", "decoder"), settings.decoder)
        self._put_decoder(settings.decoder.depth)
        for name in MODEL_SLOTS[2:]:
            self._put_component(("model", name))
        for name, section in SECTIONS.items():
            if section.named:
                self.tree[name] = {}
            for path in [path for path in parts if path[0] == name]:
                self._put_component(path)
            dropped = [key for key in section.defaults if (name, key) not in parts]
            for key in dropped if section.defaults_stay else ():
                self._put((name, key), None, self._written((name, key)))
        self._put_settings(("views",), settings.views)
        self._put_settings(("training",), settings.training)
        self._put_settings(("evaluation",), settings.evaluation)

    def _put_settings(self, path: KeyPath, config: ComponentConfig) -> None:
        for name, value in config.model_dump(mode="json").items():
            self._put((*path, name), value, self._written((*path, name)))

    def _put_component(self, path: KeyPath, chosen: Chosen | None = None) -> None:
        chosen = chosen or self.parts[path]
        node = chosen.place.node
        items = node if isinstance(node, MapNode) else MapNode(chosen.place.origin)
        kind = items.keys.get("type")
        self._put((*path, "type"), chosen.type, str(kind) if kind else "default of the slot")
        for name, value in chosen.config.model_dump(mode="json").items():
            self._put_option((*path, name), value, items.items.get(name), items, chosen.type)

    def _put_option(
        self, path: KeyPath, value: Any, node: Node | None, parent: MapNode, owner: str
    ) -> None:
        """Put an option, going into mappings that are written in part."""
        if isinstance(value, dict) and value and isinstance(node, MapNode):
            for name, item in value.items():
                self._put_option((*path, name), item, node.items.get(name), node, owner)
            return
        origin = parent.keys.get(path[-1])
        self._put(path, value, str(origin) if origin else f"default of {owner}")

    def _put_decoder(self, depth: int) -> None:
        """The template, then every layer that differs; a template that no layer uses gives way."""
        overrides: list[tuple[int, str]] = []
        for name in LAYER_SLOTS:
            template = self.parts["model", "decoder", name]
            layers = [
                self.parts["model", "decoder", "layers", str(index), name] for index in range(depth)
            ]
            if all(_same(layer, layers[0]) for layer in layers):
                template = layers[0]
            self._put_component(("model", "decoder", name), template)
            overrides += [(i, name) for i, layer in enumerate(layers) if not _same(layer, template)]
        for index, name in sorted(overrides, key=lambda pair: pair[0]):
            self._put_component(("model", "decoder", "layers", str(index), name))

    def _put(self, path: KeyPath, value: Any, origin: str) -> None:
        node = self.tree
        for key in path[:-1]:
            node = node.setdefault(key, {})
        node[path[-1]] = value
        if isinstance(value, dict) and value:
            for below in _paths_below(value, path):
                self.provenance[".".join(below)] = origin
        else:
            self.provenance[".".join(path)] = origin

    def _written(self, path: KeyPath) -> str:
        node = self.source
        for step in path[:-1]:
            node = node.child_map(step)
        return str(node.keys[path[-1]]) if path[-1] in node.items else "default"


def _same(a: Chosen, b: Chosen) -> bool:
    return a.type == b.type and a.config == b.config


def _paths_below(value: Mapping[str, Any], path: KeyPath) -> list[KeyPath]:
    found: list[KeyPath] = []
    for key, item in value.items():
        below = (*path, key)
        found += _paths_below(item, below) if isinstance(item, dict) and item else [below]
    return found


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
    parts: Mapping[KeyPath, Chosen]
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
        return self._build_named("losses")

    def build_metrics(self) -> dict[str, Metric]:
        """What evaluations measure, by the names that the recipe gives."""
        return self._build_named("metrics")

    def build_optimizer(self) -> Optimizer:
        """The optimiser; raises ValueError where `training` is too short for it."""
        return build_plain(self.parts["optimizer",], self.training)

    def build_data(self) -> SceneSource:
        """The source of scenes; raises ValueError for a recipe without data."""
        if ("data",) not in self.parts:
            raise ValueError("this recipe has no data; add `data: {type: PLUGIN/NAME}`")
        return build_plain(self.parts["data",])

    def _build_named(self, section: str) -> dict[str, Any]:
        """The components of a section such as `losses`, by name."""
        return {p[1]: build_plain(chosen) for p, chosen in self.parts.items() if p[0] == section}


def resolve(
    recipe: str | Path | Mapping[str, Any],
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
    tree = _with_defaults(tree)
    settings = decode_settings(tree, problems)
    registry = load_plugins(tree, problems, plugins)
    places = expand(tree, settings.decoder.depth, problems)
    places = apply_swaps(tree.child_map("swap"), places, problems)
    parts = decode_places(places, registry, problems)
    _check_components(parts, settings, registry, problems)
    problems.raise_any()
    return _finish(tree, settings, registry, parts)


def _with_defaults(tree: MapNode) -> MapNode:
    """`tree` with the default components of sections such as `losses`."""
    origin = Origin("default")
    for name, section in SECTIONS.items():
        if section.named and (name not in tree.items or section.defaults_stay):
            defaults = {key: {"type": kind} for key, kind in section.defaults.items()}
            node = from_plain(defaults, origin)
            if name in tree.items:
                node = merge(node, tree.items[name], (name,))
            tree = tree.with_item(name, node, tree.keys.get(name, origin))
    return tree


def _check_components(
    parts: Mapping[KeyPath, Chosen | None],
    settings: Settings,
    registry: Registry,
    problems: Problems,
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
    parts: Mapping[KeyPath, Chosen | None],
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


def annotated(recipe: Recipe) -> str:
    """The resolved recipe in YAML; comments, aligned at the right, say what set each value."""
    lines = list(_lines(recipe.tree, (), recipe.provenance))
    width = max(len(text) for text, _ in lines)
    return "\n".join(f"{text:<{width}}  # {origin}" if origin else text for text, origin in lines)


def flat(tree: Mapping[str, Any], path: tuple[str, ...] = ()) -> dict[str, Any]:
    """Dotted path to value, mappings opened."""
    values: dict[str, Any] = {}
    for key, value in tree.items():
        below = (*path, key)
        if isinstance(value, Mapping) and value:
            values |= flat(value, below)
        else:
            values[".".join(below)] = value
    return values


def _lines(
    tree: Mapping[str, Any], path: tuple[str, ...], provenance: Mapping[str, str]
) -> Iterator[tuple[str, str]]:
    indent = "  " * len(path)
    for key, value in tree.items():
        below = (*path, key)
        word = _word(key)
        if isinstance(value, Mapping) and value:
            yield f"{indent}{word}:", ""
            yield from _lines(value, below, provenance)
        else:
            yield f"{indent}{word}: {_word(value)}", provenance[".".join(below)]


def _word(value: Any) -> str:
    return dump(value, flow=True).removesuffix("\n").removesuffix("\n...")
