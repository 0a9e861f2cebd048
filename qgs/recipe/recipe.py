"""Recipes that are read, merged and checked, with every default written out; without tensors."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import Any

import torch
from torch import nn

from qgs import contracts
from qgs.machine import refuse_more_than_memory
from qgs.model import QueryGaussianModel
from qgs.recipe.build import build, build_model, load_pretrained, rate_factors
from qgs.recipe.causes import at_their_causes
from qgs.recipe.checks import check, idle_fields, unfinished
from qgs.recipe.decode import Chosen, Parts
from qgs.recipe.errors import Origin, Problems, RecipeError
from qgs.recipe.files import apply_overrides, read_recipe
from qgs.recipe.sections import SETTINGS, Draft, draft_of
from qgs.recipe.slots import SECTIONS
from qgs.recipe.yaml_text import KeyPath, MapNode, inline, items_of

Tree = Mapping[str, Any]
"""Options by name, as a recipe nests them."""


@dataclass(frozen=True)
class Recipe:
    """A recipe that has passed every check.

    tree: plain mapping with all defaults written out. `resolve` returns the same tree for this
        tree.
    provenance: the origin of each value of `tree` by dotted path: `FILE:LINE`, `--set #n`, or a
        default.
    parts: components by path. Each decoder layer has its own components, such as
        `model.decoder.layers.0.layer`.
    releases: (distribution, version) of `qgs` and of every plugin in use, by name of the plugin.
    """

    tree: Tree
    provenance: Mapping[str, str]
    parts: Parts
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
        """Options of the data source; None without a source or with options of another class."""
        config = self.parts["data",].config if ("data",) in self.parts else None
        return config if isinstance(config, contracts.SceneSourceConfig) else None

    @property
    def warnings(self) -> list[str]:
        """Warnings, one sentence each, about valid settings that are probably mistakes."""
        return [*idle_fields(self.parts), *unfinished(self.parts, self.training.steps)]

    def build_model(
        self, device: torch.device | str | None = None, pretrained: bool = True
    ) -> QueryGaussianModel:
        """Build the model with its initial parameters; the device "meta" needs no memory.

        pretrained: read pretrained weights, such as DINO's. Use False before loading a checkpoint.
        Raises TooLargeError, before memory is allocated, if the weights do not fit into memory.
        """
        if device is None or torch.device(device).type != "meta":
            # A width of 65,536 is valid, and would end in the kernel's out-of-memory killer.
            state = build_model(self, "meta").state_dict()
            sizes = {name: x.nbytes for name, x in state.items()}
            largest = max(sizes, key=sizes.__getitem__)
            fix = f"Lower the model option that sets the size of {largest}."
            refuse_more_than_memory("the recipe's model", sum(sizes.values()), fix)
        model = build_model(self, device)
        model.releases = self.releases
        if pretrained:
            load_pretrained(model)
        return model

    def build_losses(self, pretrained: bool = True) -> dict[str, contracts.Loss]:
        """Build the losses, by their names in the recipe.

        pretrained: read pretrained weights, such as those of a perceptual loss.
        """
        losses = self._named("losses")
        if pretrained:
            load_pretrained(*losses.values())
        return losses

    def build_metrics(self) -> dict[str, contracts.Metric]:
        """Build the metrics, by their names in the recipe."""
        metrics = self._named("metrics")
        for metric in metrics.values():
            try:
                load_pretrained(metric)
            except contracts.MissingExtraError as error:
                # Evaluations go on with the other metrics.
                metric.unavailable = str(error)
        return metrics

    def _named(self, section: str) -> dict[str, Any]:
        return {at[1]: build(part) for at, part in self.parts.items() if at[0] == section}

    def build_objective(self) -> contracts.Objective:
        """Build the objective, which computes the losses of a training step."""
        return build(self.parts["objective",])

    def build_optimizer(self) -> contracts.Optimizer:
        """Build the optimiser; raise ValueError if `training` is too short for the optimiser."""
        optimizer = build(self.parts["optimizer",], self.training)
        optimizer.check()
        return optimizer

    def rate_factors(self, module: nn.Module) -> dict[str, float]:
        """Return the learning-rate factor of every parameter of `module`, by parameter name."""
        return rate_factors(module, self.parts["optimizer",])

    def build_view_sampler(self) -> contracts.ViewSampler:
        """Build the sampler that chooses input and target frames of a scene."""
        return build(self.parts["view_sampler",])

    def build_data(self) -> contracts.SceneSource:
        """Build the data source; raise ValueError if the recipe names none."""
        if ("data",) not in self.parts:
            raise ValueError("this recipe has no data; add `data: {type: PLUGIN/NAME}`")
        return build(self.parts["data",])


def resolve(
    recipe: str | Path | Tree,
    overrides: Sequence[str] = (),
    plugins: Sequence[contracts.Plugin] = (),
) -> Recipe:
    """Read, merge and check a recipe, and fill in its defaults.

    recipe: path of a YAML file, or the name of a recipe that comes with qgs (tiny/locus.yaml), or a
        mapping of the same form. `extends` in a mapping is relative to the working directory.
    overrides: changes such as "model.queries.count=128", applied in order.
    plugins: plugins that the recipe may name although they are not installed, such as one under
        test.
    Raises RecipeError with all problems found.
    """
    problems = Problems()
    written = apply_overrides(read_recipe(recipe, problems), overrides, problems)
    draft = draft_of(written, problems, plugins)
    try:
        parts = check(draft, problems)
    except RecipeError as error:
        raise RecipeError(at_their_causes(written, error.problems, plugins)) from error.__cause__
    settings = draft.settings
    tree: dict[str, Any] = {}
    provenance: dict[str, str] = {}
    for path, value, origin in spell_out(draft, parts):
        holder = tree
        for key in path[:-1]:
            holder = holder.setdefault(key, {})
        holder[path[-1]] = value
        provenance[".".join(path)] = str(origin)
    used = [draft.registry.plugins[name] for name in ("qgs", *tree["plugins"])]
    return Recipe(
        tree=tree,
        provenance=provenance,
        parts=parts,
        dims=draft.dims,
        layer_scale=settings.model.decoder.layer_scale,
        seed=settings.seed,
        init_from=settings.init_from,
        views=settings.views,
        training=settings.training,
        evaluation=settings.evaluation,
        releases={one.plugin.name: (one.distribution, one.version) for one in used},
    )


_DEFAULT = "default"
_Spelled = Iterator[tuple[KeyPath, Any, Origin | str]]
"""Path, value and origin of each value of a recipe."""


def spell_out(draft: Draft, parts: Parts) -> _Spelled:
    """Yield path, value and origin of each option of the recipe `draft`, including defaults.

    The value of `plugins` lists only plugins whose components the draft uses.
    """
    shown = _shown_parts(parts)
    top, model, decoder, *sections = SETTINGS
    encoder, queries, *others = shown
    for path in (top, model, encoder, queries, decoder, *others, *sections):
        if path in shown:
            part = shown[path]
            yield (*path, "type"), part.type, part.chosen_at
            yield from _spelled(path, part.options, part.node, f"default of {part.type}")
        else:
            settings = reduce(getattr, path, draft.settings)
            values = settings.model_dump(mode="json", include={*SETTINGS[path].model_fields})
            yield from _spelled(path, values, draft.tree.child(*path), _DEFAULT)
    yield _plugins(draft, {part.installed.plugin.name for part in shown.values()})
    for name, section in SECTIONS.items():
        # Without `null` the default metric would return when the recipe is read again.
        staying = section.defaults if section.defaults_stay else ()
        for key in staying:
            if (name, key) not in parts:
                yield (name, key), None, draft.tree.child(name).origin_of(key)
        # An empty section differs from a missing one, which gets the defaults.
        if section.defaults and not staying and not any(path[0] == name for path in parts):
            yield (name,), {}, draft.tree.origins.get(name, _DEFAULT)


def _spelled(path: KeyPath, values: Tree, written: MapNode, default: Origin | str) -> _Spelled:
    """Yield path, value and origin of each of `values`, which are options at `path`.

    written: options that the recipe sets. Other options have the origin `default`.
    """
    for name, value in values.items():
        origin = written.origins.get(name, default)
        if isinstance(value, dict) and value:
            inner = default if isinstance(written.get(name), MapNode) else origin
            yield from _spelled((*path, name), value, written.child(name), inner)
        else:
            yield (*path, name), value, origin


def _plugins(draft: Draft, used: set[str]) -> tuple[KeyPath, Any, Origin | str]:
    """Return the path `plugins`, names of the plugins in `used`, and the lines that name them."""
    kept = [name for name in draft.registry.plugins if name != "qgs" and name in used]
    origin = draft.tree.origins.get("plugins", Origin(_DEFAULT))
    lines = [str(at) for name, at in items_of(draft.tree.get("plugins"), origin) if name in kept]
    return ("plugins",), kept, ", ".join(dict.fromkeys(lines)) or origin


def _shown_parts(parts: Parts) -> dict[KeyPath, Chosen]:
    """Return components by path, without components that a complete recipe need not repeat.

    A path without a layer number, such as `model.decoder.layer`, stands for all decoder layers. If
    all layers have the same component, the result has only this path. Otherwise, it also has a path
    such as `model.decoder.layers.0.layer` for each layer that differs from this path's component.
    """
    shown = {path: part for path, part in parts.items() if "layers" not in path}
    layers = {path: part for path, part in parts.items() if "layers" in path}
    for path in [*shown]:
        # A swap of all layers reads better as the template.
        standing = [part for at, part in layers.items() if (*at[:2], at[-1]) == path]
        if standing and all(part.equals(standing[0]) for part in standing):
            shown[path] = standing[0]
    own = {p: part for p, part in layers.items() if not part.equals(shown[*p[:2], p[-1]])}
    return shown | own


def flat(tree: Tree, above: str = "") -> dict[str, Any]:
    """Flatten nested mappings to one mapping from dotted path to value."""
    found: dict[str, Any] = {}
    for key, value in tree.items():
        if isinstance(value, Mapping) and value:
            found |= flat(value, f"{above}{key}.")
        else:
            found[above + key] = value
    return found


def differing_options(a: Tree, b: Tree) -> dict[str, tuple[str | None, str | None]]:
    """Return the options that differ between the recipes `a` and `b`.

    Maps the dotted path of each option to its two values as YAML. None stands for an option that a
    recipe does not have.
    """
    ours, theirs = ({key: inline(value) for key, value in flat(x).items()} for x in (a, b))
    pairs = {key: (ours.get(key), theirs.get(key)) for key in ours | theirs}
    return {key: pair for key, pair in pairs.items() if pair[0] != pair[1]}


_NO_EFFECT_ONCE_TRAINED = re.compile(
    r"(\b|_)(init|std|layer_scale)(\b|_)|^model\.(supervision|renderer)\."
)


def differing_predictions(a: Tree, b: Tree) -> dict[str, tuple[str, str]]:
    """Return the `differing_options` that change the predictions of a trained model.

    Options of initial values, supervision and renderer are left out, since a trained model predicts
    the same without them. "none" stands for an option that a recipe does not have.
    """
    return {
        path: (ours or "none", theirs or "none")
        for path, (ours, theirs) in differing_options(a, b).items()
        if path.startswith("model.") and not _NO_EFFECT_ONCE_TRAINED.search(path)
    }


def annotated(recipe: Recipe) -> str:
    """Write the complete recipe as YAML with comments that give file and line of each value."""

    def lines_of(tree: Tree, path: KeyPath) -> Iterator[tuple[str, str]]:
        for key, value in tree.items():
            below = (*path, key)
            name = "  " * len(path) + inline(key)
            if isinstance(value, Mapping) and value:
                yield f"{name}:", ""
                yield from lines_of(value, below)
            else:
                yield f"{name}: {inline(value)}", recipe.provenance[".".join(below)]

    lines = list(lines_of(recipe.tree, ()))
    # One long list must not move the comments of all lines.
    width = min(max(len(text) for text, _ in lines), 100)
    return "\n".join(f"{text:<{width}}  # {origin}" if origin else text for text, origin in lines)
