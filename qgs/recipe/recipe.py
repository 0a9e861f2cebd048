"""Resolving a recipe: read, merge, check, and write out every default; no tensor is allocated."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import nn

from qgs import contracts
from qgs.contracts import LAYER_SLOTS
from qgs.contracts.schedule import Schedule
from qgs.machine import refuse_more_than_memory
from qgs.model import QueryGaussianModel
from qgs.recipe.build import build, build_model, load_pretrained, rate_factors
from qgs.recipe.decode import Chosen, DecoderSettings, check_tree, decode_place, decode_settings
from qgs.recipe.errors import Origin, Problems
from qgs.recipe.files import apply_overrides, merge, read_recipe
from qgs.recipe.flow import (
    Parts,
    check_flow,
    check_options,
    idle_fields,
    unfinished,
    without_idle_sublayers,
)
from qgs.recipe.places import apply_swaps, expand
from qgs.recipe.registry import Registry, load_plugins
from qgs.recipe.slots import MODEL_SLOTS, SECTIONS
from qgs.recipe.yaml_text import KeyPath, ListNode, MapNode, from_plain, inline


@dataclass(frozen=True)
class Recipe:
    """A recipe that has passed every check.

    tree: plain mapping, every default spelled out; resolving it again gives the same.
    provenance: dotted path of each value of `tree` to `FILE:LINE`, `--set #n`, or the default that
        set it.
    parts: path of each place, decoder layers numbered, to the component that stands there.
    releases: name to (distribution, version) of every plugin in use, `qgs` included.
    """

    tree: Mapping[str, Any]
    provenance: Mapping[str, str]
    parts: Mapping[KeyPath, Chosen]
    dims: contracts.ModelDims
    layer_scale: float
    seed: int
    init_from: str | None
    views: contracts.ViewsConfig
    training: contracts.TrainingConfig
    evaluation: contracts.EvaluationConfig
    releases: Mapping[str, tuple[str, str]]

    @property
    def data_config(self) -> contracts.SceneSourceConfig | None:
        """The options of its data source; None without one, or where that has other options."""
        config = self.parts["data",].config if ("data",) in self.parts else None
        return config if isinstance(config, contracts.SceneSourceConfig) else None

    @property
    def warnings(self) -> list[str]:
        """What works and is probably not what was meant, a sentence each."""
        length = self.training.steps, self.training.seconds
        return [*idle_fields(self.parts), *unfinished(self.parts, *length)]

    @property
    def schedules(self) -> dict[KeyPath, Mapping[str, Schedule]]:
        """Of each place with options that follow the progress of training, these options."""
        return {path: part.schedules for path, part in self.parts.items() if part.schedules}

    def build_model(
        self, device: torch.device | str | None = None, pretrained: bool = True
    ) -> QueryGaussianModel:
        """The model with its initial parameters; on "meta" it takes no memory.

        pretrained: components read the weights that options name; False where a checkpoint follows.
        Raises TooLargeError for weights that do not fit into memory, before any is made.
        """
        arguments = self.parts, self.dims, self.layer_scale, self.seed, self.tree
        if device is None or torch.device(device).type != "meta":
            state = build_model(*arguments, "meta").state_dict()
            sizes = {name: x.numel() * x.element_size() for name, x in state.items()}
            fix = "Lower the option of the model that makes the largest of them."
            refuse_more_than_memory("the model with its weights", sizes, fix)
        model = build_model(*arguments, device)
        model.releases = self.releases
        if pretrained:
            load_pretrained(model)
        return model

    def build_losses(self, pretrained: bool = True) -> dict[str, contracts.Loss]:
        """Losses by the names that the recipe gives; only one without data may have none."""
        losses = {path[1]: build(part) for path, part in self.parts.items() if path[0] == "losses"}
        if pretrained:
            load_pretrained(*losses.values())
        return losses

    def build_objective(self) -> contracts.Objective:
        """What a training step computes."""
        return build(self.parts["objective",])

    def build_metrics(self) -> dict[str, contracts.Metric]:
        """What evaluations measure, by the names that the recipe gives."""
        found = {path[1]: build(part) for path, part in self.parts.items() if path[0] == "metrics"}
        for metric in found.values():
            try:
                load_pretrained(metric)
            except contracts.MissingExtraError as error:
                metric.unavailable = str(error)  # evaluations go on with the other metrics
        return found

    def build_optimizer(self) -> contracts.Optimizer:
        """The optimiser; raises ValueError where `training` is too short for it."""
        optimizer = build(self.parts["optimizer",], self.training)
        optimizer.check()
        return optimizer

    def rate_factors(self, module: nn.Module) -> dict[str, float]:
        """Factor of the learning rate for every parameter of a model or objective, by name."""
        return rate_factors(module, self.parts["optimizer",])

    def build_view_sampler(self) -> contracts.ViewSampler:
        """What draws the frames of samples."""
        return build(self.parts["view_sampler",])

    def build_data(self) -> contracts.SceneSource:
        """The source of scenes; raises ValueError for a recipe without data."""
        if ("data",) not in self.parts:
            raise ValueError("this recipe has no data; add `data: {type: PLUGIN/NAME}`")
        return build(self.parts["data",])


def resolve(
    recipe: str | Path | Mapping[str, Any],
    overrides: Sequence[str] = (),
    plugins: Sequence[contracts.Plugin] = (),
) -> Recipe:
    """Read, merge and check a recipe.

    recipe: path of a YAML file, else the name of one that comes with qgs (tiny/locus.yaml); or a
        mapping of the same form, whose `extends` is relative to the working directory.
    overrides: such as "model.queries.count=128", laid over it in order.
    plugins: plugins that it may name although they are not installed, such as one under test.
    Raises RecipeError with every problem that was found.
    """
    problems = Problems()
    tree = apply_overrides(read_recipe(recipe, problems), overrides, problems)
    tree = check_tree(tree, problems)
    problems.raise_if_stopped()
    tree = _with_defaults(tree)
    settings, sizes_known = decode_settings(tree, problems)
    model, decoder = settings["model",], settings["model", "decoder"]
    dims = contracts.ModelDims(model.width, model.heads, decoder.depth)
    registry = load_plugins(tree, problems, plugins)
    places = apply_swaps(tree.child("swap"), expand(tree, dims.depth, problems), problems)
    decoded = {path: decode_place(place, registry, problems) for path, place in places.items()}
    parts = without_idle_sublayers(decoded, dims.depth, problems)
    if sizes_known:
        data = parts.get(("data",))
        source = data.config if data else None
        size = source.image_size if isinstance(source, contracts.SceneSourceConfig) else None
        inputs = settings["views",].inputs if data else None
        timed = bool(data and getattr(data.component, "tells_times", False))
        context = contracts.RecipeContext(dims, size, inputs, timed)
        checked = {
            p: c if c and check_options(c, context, problems) else None for p, c in parts.items()
        }
        check_flow(checked, dims.depth, registry, problems)
    _check_settings(tree, settings, parts, registry, problems)
    problems.raise_any()
    chosen = {path: part for path, part in parts.items() if part is not None}
    out = _spell_out(tree, settings, registry, chosen)
    return Recipe(
        tree=out.values,
        provenance=out.provenance,
        parts=chosen,
        dims=dims,
        layer_scale=decoder.layer_scale,
        seed=settings[()].seed,
        init_from=settings[()].init_from,
        views=settings["views",],
        training=settings["training",],
        evaluation=settings["evaluation",],
        releases={
            name: (registry.plugins[name].distribution, registry.plugins[name].version)
            for name in ("qgs", *out.values["plugins"])
        },
    )


def _check_settings(
    tree: MapNode,
    settings: Mapping[KeyPath, Any],
    parts: Parts,
    registry: Registry,
    problems: Problems,
) -> None:
    """Report settings that contradict the components, or have no effect with them."""

    def report(path: KeyPath, reason: str, fix: str) -> None:
        node = tree.child(*path[:-1])
        problems.add(node.origins.get(path[-1], node.origin), ".".join(path), reason, fix)

    encoder, objective = parts["model", "encoder"], parts["objective",]
    if encoder and settings["evaluation",].tuning == "latents":
        known: dict[str, Any] = dict(registry.components("encoder"))
        if not known[encoder.type].tunable:
            others = " or ".join(f"`{name}`" for name in sorted(known) if known[name].tunable)
            reason = f"`{encoder.type}` at model.encoder has no latents to tune"
            fix = f"write `queries`, or use {others} in the slot `encoder`"
            report(("evaluation", "tuning"), reason, fix)

    decoder, default = settings["model", "decoder"], DecoderSettings().layer_scale
    layers = [parts["model", "decoder", "layers", str(i), "layer"] for i in range(decoder.depth)]
    kinds: list[Any] = [layer.component if layer else contracts.DecoderLayer for layer in layers]
    if decoder.layer_scale != default and not any(kind.reads_layer_scale for kind in kinds):
        names = " and ".join(sorted({f"`{layer.type}`" for layer in layers if layer}))
        reason = f"it has no effect: {names or 'a decoder of depth 0'} does not read it"
        fix = f"remove it; the default, `layer_scale: {inline(default)}`, drops an inherited one"
        report(("model", "decoder", "layer_scale"), reason, fix)

    if settings["training",].judge_inputs:
        path, fix = ("training", "judge_inputs"), "set it to false; evaluations do not read it"
        if settings["views",].pose_noise:
            reason = "views.pose_noise moves the cameras of input views, which must be exact"
            report(path, reason, fix)
        kind: Any = objective.component if objective else contracts.Objective
        if objective and not kind.judges_inputs:
            reason = f"`{objective.type}` reconstructs one moment, input views show others"
            report(path, reason, fix)

    if ("data",) in parts and not any(path[0] == "losses" for path in parts):
        reason = "a recipe with data needs at least one loss to train"
        report(("losses",), reason, "add one under `losses`, or drop the data with `data: null`")


def _with_defaults(tree: MapNode) -> MapNode:
    """`tree` with the default components of sections such as `losses` under what is written."""
    missing = {
        name: {key: {"type": kind} for key, kind in section.defaults.items()}
        for name, section in SECTIONS.items()
        if section.named and (section.defaults_stay or name not in tree)
    }
    defaults = from_plain(missing, Origin("default"))
    assert isinstance(defaults, MapNode)
    return merge(defaults, tree)


def _spell_out(
    source: MapNode,
    settings: Mapping[KeyPath, contracts.ComponentConfig],
    registry: Registry,
    parts: Mapping[KeyPath, Chosen],
) -> "_Tree":
    """What `source` describes, with every default; only plugins that are used."""
    tree = _Tree(source)
    tree.put_settings((), settings[()])
    tree.values["plugins"] = []  # known at the end
    tree.put_settings(("model",), settings["model",])
    for name in MODEL_SLOTS:
        tree.put_component(("model", name), parts["model", name])
        if name == "queries":
            tree.put_settings(("model", "decoder"), settings["model", "decoder"])
            _put_decoder(tree, parts)
    for name, section in SECTIONS.items():
        for path, part in parts.items():
            if path[0] == name:
                tree.put_component(path, part)
        dropped = [key for key in section.defaults if (name, key) not in parts]
        if section.defaults_stay:
            tree.put((name,), dict.fromkeys(dropped), source.child(name), "default")
        if section.named and not tree.values.get(name):
            tree.put((), {name: {}}, source, "default")
    for name in ("views", "training", "evaluation"):
        tree.put_settings((name,), settings[name,])
    # A plugin with weight layouts alone has no component to use: `qgs import` reads it.
    found = registry.plugins.items()
    kept = [n for n, p in found if n in tree.used - {"qgs"} or not p.plugin.components]
    tree.put((), {"plugins": kept}, source, "default")
    written = source.get("plugins")
    if isinstance(written, ListNode) and kept:
        origins = [o for n, o in zip(written, written.origins, strict=True) if n in kept]
        tree.provenance["plugins"] = ", ".join(dict.fromkeys(map(str, origins)))
    return tree


def _put_decoder(tree: "_Tree", parts: Mapping[KeyPath, Chosen]) -> None:
    """The template, then every layer that differs; a template that no layer uses gives way."""
    decoder = ("model", "decoder")
    layers = {path: part for path, part in parts.items() if path[:-2] == (*decoder, "layers")}
    templates = {}
    for name in LAYER_SLOTS:
        if (*decoder, name) not in parts:
            continue
        standing = [part for path, part in layers.items() if path[-1] == name]
        chosen = [(part.type, part.options) for part in standing]
        same = chosen.count(chosen[0]) == len(chosen)
        template = standing[0] if same else parts[(*decoder, name)]
        tree.put_component((*decoder, name), template)
        templates[name] = (template.type, template.options)
    for path, part in layers.items():
        if (part.type, part.options) != templates[path[-1]]:
            tree.put_component(path, part)


class _Tree:
    """The plain mapping of a resolved recipe, its provenance, and the plugins that it uses."""

    def __init__(self, source: MapNode) -> None:
        self.source, self.used = source, set[str]()
        self.values: dict[str, Any] = {}
        self.provenance: dict[str, str] = {}

    def put(self, path: KeyPath, values: Mapping[str, Any], written: Any, default: str) -> None:
        """written: what the recipe has at `path`; the rest is set by `default`."""
        origins = written.origins if isinstance(written, MapNode) else {}
        below = self.values
        for key in path:
            below = below.setdefault(key, {})
        for name, value in values.items():
            inner = written.get(name) if origins else None
            if isinstance(value, dict) and value and isinstance(inner, MapNode):
                self.put((*path, name), value, inner, default)
            else:
                below[name] = value
                origin = str(origins.get(name, default))
                self.provenance.update(dict.fromkeys(flat({name: value}, path), origin))

    def put_settings(self, path: KeyPath, config: contracts.ComponentConfig) -> None:
        self.put(path, config.model_dump(mode="json"), self.source.child(*path), "default")

    def put_component(self, path: KeyPath, chosen: Chosen) -> None:
        self.used.add(chosen.installed.plugin.name)
        self.put(path, {"type": chosen.type}, chosen.place.node, "default of the slot")
        self.put(path, chosen.options, chosen.place.node, f"default of {chosen.type}")


def flat(tree: Mapping[str, Any], path: KeyPath = ()) -> dict[str, Any]:
    """Dotted path to value, mappings opened."""
    values: dict[str, Any] = {}
    for key, value in tree.items():
        below = (*path, key)
        if isinstance(value, Mapping) and value:
            values |= flat(value, below)
        else:
            values[".".join(below)] = value
    return values


def differing_options(
    a: Mapping[str, Any], b: Mapping[str, Any]
) -> dict[str, tuple[str | None, str | None]]:
    """Dotted paths of the options that differ between two recipes, to both values as YAML.

    None stands for an option that a recipe does not have.
    """
    of_a, of_b, absent = flat(a), flat(b), object()
    return {
        path: (
            inline(of_a[path]) if path in of_a else None,
            inline(of_b[path]) if path in of_b else None,
        )
        for path in of_a | of_b
        if of_a.get(path, absent) != of_b.get(path, absent)
    }


_NO_EFFECT_ONCE_TRAINED = re.compile(
    r"(\b|_)(init|std|layer_scale)(\b|_)|^model\.(supervision|renderer)\."
)


def differing_predictions(a: Mapping[str, Any], b: Mapping[str, Any]) -> dict[str, tuple[str, str]]:
    """`differing_options` that change what a model with given weights predicts, "none" for None.

    Initial values, supervision and the renderer do not.
    """
    return {
        path: (ours or "none", theirs or "none")
        for path, (ours, theirs) in differing_options(a, b).items()
        if path.startswith("model.") and not _NO_EFFECT_ONCE_TRAINED.search(path)
    }


def annotated(recipe: Recipe) -> str:
    """The resolved recipe in YAML; aligned comments name the file and line that set each value."""

    def lines_of(tree: Mapping[str, Any], path: KeyPath) -> Iterator[tuple[str, str]]:
        for key, value in tree.items():
            below, name = (*path, key), "  " * len(path) + inline(key)
            if isinstance(value, Mapping) and value:
                yield f"{name}:", ""
                yield from lines_of(value, below)
            else:
                yield f"{name}: {inline(value)}", recipe.provenance[".".join(below)]

    lines = list(lines_of(recipe.tree, ()))
    width = min(max(len(text) for text, _ in lines), 100)  # one long list must not move them all
    return "\n".join(f"{text:<{width}}  # {origin}" if origin else text for text, origin in lines)
