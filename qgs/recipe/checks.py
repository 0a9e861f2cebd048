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
from qgs.recipe.places import DECODER, layer_places
from qgs.recipe.registry import component_failure
from qgs.recipe.sections import DecoderSettings
from qgs.recipe.yaml_text import KeyPath, find, inline


def check(draft: Draft, problems: Problems) -> Parts:
    """The parts that a layer has a slot for; raises RecipeError for all that does not fit."""
    parts = _without_idle_sublayers(draft, problems)
    context = _context(draft)
    sound = [_check_options(part, context, problems) for part in parts.values()]
    if all(sound):
        check_flow(parts, draft.dims.depth, draft.registry, problems)
    for path, reason, fix in [*_contradictions(draft, parts), *_idle_layer_scale(draft, parts)]:
        section = draft.tree.child(*path[:-1])
        problems.add(section.origin_of(path[-1]), path, reason, fix)
    problems.raise_any()
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
        problems.add(chosen.origin, chosen.source, failure.reason, failure.fix, error)
        return False
    for problem in found:
        steps, origin, _ = find(chosen.node, problem.option.split("."))
        path = f"{chosen.shown_path}.{problem.option}" if problem.option else chosen.source
        problems.add(origin if steps else chosen.origin, path, problem.reason, problem.fix)
    return True


def _without_idle_sublayers(draft: Draft, problems: Problems) -> Parts:
    """The parts without components in slots that no layer has; reports those that are written.

    A template used by any layer is not reported.
    """
    kept = dict(draft.parts)
    layers: dict[KeyPath, Any] = {
        path[:-1]: kept[path] for path in layer_places(draft.dims.depth, "layer")
    }
    read = {name for layer in layers.values() for name in layer.component.sublayers}
    for place, layer in layers.items():
        for name in {*SUBLAYER_SLOTS} - {*layer.component.sublayers}:
            idle = kept.pop((*place, name))
            if not (idle.source == (*DECODER, name) and name in read):
                reason = f"`{layer.type}` ({layer.chosen_at}) has no slot `{name}`"
                _report_idle(idle, reason, problems)
    for name in LAYER_SLOTS:
        if not any((*place, name) in kept for place in layers):
            template = kept.pop((*DECODER, name))
            if not layers:
                reason = "a decoder of depth 0 has no layers, so nothing reads it"
                _report_idle(template, reason, problems)
    return kept


def _report_idle(idle: Chosen, reason: str, problems: Problems) -> None:
    # What is a default is nobody's mistake.
    if idle.node:
        fix = f"remove it; `{idle.slot}: null` drops one that is inherited"
        problems.add(idle.origin, idle.source, reason, fix)


def _contradictions(draft: Draft, parts: Parts) -> Iterator[tuple[KeyPath, str, str]]:
    """Path, reason and fix of settings that contradict the components."""
    settings = draft.settings
    encoder: Any = parts["model", "encoder"]
    # Tuning fits what an encoder can make keys and values of anew.
    if settings["evaluation",].tuning == "latents" and not encoder.component.tunable:
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
        if not objective.component.judges_inputs:
            reason = f"`{objective.type}` reconstructs one moment, input views show others"
            yield path, reason, fix
    if ("data",) in parts and not any(path[0] == "losses" for path in parts):
        reason = "a recipe with data needs at least one loss to train"
        yield ("losses",), reason, "add one under `losses`, or drop the data with `data: null`"


def _idle_layer_scale(draft: Draft, parts: Parts) -> Iterator[tuple[KeyPath, str, str]]:
    """Path, reason and fix where `layer_scale` was changed and no layer reads it."""
    # A resolved recipe writes the default out, which must stay valid.
    default = DecoderSettings().layer_scale
    layers: list[Any] = [parts[place] for place in layer_places(draft.dims.depth, "layer")]
    read = any(layer.component.reads_layer_scale for layer in layers)
    if not read and draft.settings[DECODER].layer_scale != default:
        names = " and ".join(sorted({f"`{layer.type}`" for layer in layers}))
        reason = f"it has no effect: {names or 'a decoder of depth 0'} does not read it"
        fix = f"remove it; the default, `layer_scale: {inline(default)}`, drops an inherited one"
        yield (*DECODER, "layer_scale"), reason, fix
