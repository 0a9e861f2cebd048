"""Checks of a recipe as a whole: each component beside the others and beside the settings."""

from collections.abc import Iterator
from typing import Any

from qgs.contracts import (
    LAYER_SLOTS,
    SUBLAYER_SLOTS,
    RecipeContext,
    SceneSourceConfig,
    Supervision,
)
from qgs.recipe.decode import Chosen, Parts
from qgs.recipe.draft import Draft
from qgs.recipe.errors import Problems
from qgs.recipe.flow import check_flow
from qgs.recipe.registry import component_failure
from qgs.recipe.sections import DecoderSettings
from qgs.recipe.yaml_text import KeyPath, find, inline


def check(draft: Draft, problems: Problems) -> Parts:
    """Report what does not fit together; the parts of `draft` that a layer has a slot for."""
    parts = _without_idle_sublayers(draft, problems)
    if draft.sizes_known:
        context = _context(draft)
        sound = {
            path: part if part and _check_options(part, context, problems) else None
            for path, part in parts.items()
        }
        check_flow(sound, draft.dims.depth, draft.registry, problems)
    _check_settings(draft, parts, problems)
    return parts


def _context(draft: Draft) -> RecipeContext:
    data = draft.parts.get(("data",))
    if data is None:
        return RecipeContext(draft.dims)
    source = data.config
    size = source.image_size if isinstance(source, SceneSourceConfig) else None
    timed = bool(getattr(data.component, "tells_times", False))
    return RecipeContext(draft.dims, size, draft.settings["views",].inputs, timed)


def _check_options(chosen: Chosen, context: RecipeContext, problems: Problems) -> bool:
    """Report what is wrong with a component's options; whether its declarations can be read."""
    component = chosen.component
    config = chosen.config
    called = "fields_read"
    try:
        component.fields_read(config)
        called = "fields_written"
        component.fields_written(config)
        if issubclass(component, Supervision):
            called = "weights"
            # `check_flow` asks for them, outside of this guard.
            component(config).weights()
        called = "problems"
        # A scheduled option must be valid at every extreme of its schedule.
        found = dict.fromkeys(
            problem
            for options in (config, *chosen.later)
            for problem in component.problems(options, context)
        )
    # What code of a plugin raises.
    except Exception as error:
        failure = component_failure(chosen.type, called, error, chosen.installed)
        problems.add(chosen.place.origin, chosen.path, failure.reason, failure.fix, error)
        return False
    for problem in found:
        steps, origin, _ = find(chosen.node, problem.option.split("."))
        path = f"{chosen.path}.{problem.option}" if problem.option else chosen.path
        problems.add(origin if steps else chosen.place.origin, path, problem.reason, problem.fix)
    return True


def _without_idle_sublayers(draft: Draft, problems: Problems) -> Parts:
    """The parts without components in slots that no layer has; reports those that are written.

    A template used by any layer is not reported; layers that failed to decode are skipped.
    """
    kept = dict(draft.parts)
    reported = set[str]()

    def report(idle: Chosen | None, name: str, reason: str) -> None:
        if idle and idle.place.node is not None and idle.path not in reported:
            reported.add(idle.path)
            fix = f"remove it; `{name}: null` drops one that is inherited"
            problems.add(idle.place.origin, idle.path, reason, fix)

    decoder = ("model", "decoder")
    places = [(*decoder, "layers", str(index)) for index in range(draft.dims.depth)]
    layers: dict[KeyPath, Any] = {place: kept[*place, "layer"] for place in places}
    read = {name for layer in layers.values() if layer for name in layer.component.sublayers}
    for place, layer in layers.items():
        for name in SUBLAYER_SLOTS if layer else ():
            if name in layer.component.sublayers:
                continue
            idle = kept.pop((*place, name))
            if idle and not (idle.place.source == (*decoder, name) and name in read):
                report(idle, name, f"`{layer.type}` ({layer.chosen_at}) has no slot `{name}`")
    for name in LAYER_SLOTS:
        if not any((*place, name) in kept for place in places):
            template = kept.pop((*decoder, name))
            if not places:
                report(template, name, "a decoder of depth 0 has no layers, so nothing reads it")
    return kept


def _check_settings(draft: Draft, parts: Parts, problems: Problems) -> None:
    """Report settings that contradict the components, or have no effect with them."""
    for path, reason, fix in [*_contradictions(draft, parts), *_idle_layer_scale(draft, parts)]:
        section = draft.tree.child(*path[:-1])
        problems.add(section.origin_of(path[-1]), path, reason, fix)


def _contradictions(draft: Draft, parts: Parts) -> Iterator[tuple[KeyPath, str, str]]:
    """Path, reason and fix."""
    settings = draft.settings
    encoder: Any = parts["model", "encoder"]
    # Tuning fits what an encoder can make keys and values of anew.
    if encoder and settings["evaluation",].tuning == "latents" and not encoder.component.tunable:
        known: dict[str, Any] = draft.registry.components("encoder")
        others = " or ".join(f"`{name}`" for name in sorted(known) if known[name].tunable)
        reason = f"`{encoder.type}` at model.encoder has no latents to tune"
        fix = f"write `queries`, or use {others} in the slot `encoder`"
        yield ("evaluation", "tuning"), reason, fix
    if settings["training",].judge_inputs:
        path = ("training", "judge_inputs")
        fix = "set it to false; evaluations do not read it"
        # A loss would compare renderings from moved cameras with photos from true ones.
        if settings["views",].pose_noise:
            reason = "views.pose_noise moves the cameras of input views, which must be exact"
            yield path, reason, fix
        objective: Any = parts["objective",]
        if objective and not objective.component.judges_inputs:
            reason = f"`{objective.type}` reconstructs one moment, input views show others"
            yield path, reason, fix
    if ("data",) in parts and not any(path[0] == "losses" for path in parts):
        reason = "a recipe with data needs at least one loss to train"
        yield ("losses",), reason, "add one under `losses`, or drop the data with `data: null`"


def _idle_layer_scale(draft: Draft, parts: Parts) -> Iterator[tuple[KeyPath, str, str]]:
    """Path, reason and fix where `layer_scale` was changed and no layer reads it."""
    # A resolved recipe writes the default out, which must stay valid.
    default = DecoderSettings().layer_scale
    places = [("model", "decoder", "layers", str(index)) for index in range(draft.dims.depth)]
    layers: list[Any] = [parts[*place, "layer"] for place in places]
    # A layer that could not be decoded might read it.
    read = any(layer is None or layer.component.reads_layer_scale for layer in layers)
    if not read and draft.settings["model", "decoder"].layer_scale != default:
        names = " and ".join(sorted({f"`{layer.type}`" for layer in layers}))
        reason = f"it has no effect: {names or 'a decoder of depth 0'} does not read it"
        fix = f"remove it; the default, `layer_scale: {inline(default)}`, drops an inherited one"
        yield ("model", "decoder", "layer_scale"), reason, fix
