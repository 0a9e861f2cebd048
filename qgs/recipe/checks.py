"""Checks of a whole recipe: do its components fit each other and the settings?

Each field of the model's state must be written before a component reads it, in the order of a
forward pass.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import product, takewhile
from typing import Any

from qgs.contracts import (
    LAYER_SLOTS,
    SUBLAYER_SLOTS,
    Component,
    ComponentConfig,
    Fields,
    FieldSpec,
    Problem,
    RecipeContext,
    Refinement,
    SceneSourceConfig,
    Supervision,
)
from qgs.recipe.decode import Chosen, Parts, report_failure
from qgs.recipe.errors import Problems
from qgs.recipe.places import DECODER, layer_place
from qgs.recipe.registry import Registry, default_config
from qgs.recipe.sections import DecoderSettings, Draft
from qgs.recipe.slots import SLOTS
from qgs.recipe.yaml_text import KeyPath, find, inline


def check(draft: Draft, problems: Problems) -> Parts:
    """Check a draft, a recipe whose components are chosen; return its components.

    Sublayers that no decoder layer uses are left out. Raises RecipeError with all problems.
    """
    parts = _without_idle_sublayers(draft, problems)
    contexts = _contexts(draft)
    sound = [_check_options(part, contexts, problems) for part in parts.values()]
    if all(sound):
        check_flow(parts, draft.dims.depth, draft.registry, problems)
    for path, reason, fix in _contradictions(draft, parts):
        section = draft.tree.child(*path[:-1])
        problems.add(section.origin_of(path[-1]), path, reason, fix)
    problems.raise_any()
    return parts


def _contexts(draft: Draft) -> Sequence[RecipeContext]:
    """Return a context for each image size of the data and of the training."""
    data: Any = draft.parts.get(("data",))
    if data is None:
        return [RecipeContext(draft.dims)]
    source = data.config
    size = source.image_size if isinstance(source, SceneSourceConfig) else None
    inputs = draft.settings.views.inputs
    times = data.component.tells_times
    sizes = (size, *draft.settings.training.image_sizes)
    return [RecipeContext(draft.dims, each, inputs, times) for each in sizes]


def _check_options(chosen: Chosen, contexts: Sequence[RecipeContext], problems: Problems) -> bool:
    """Report problems of a component's options; return False if a method of the component fails.

    Otherwise returns True, even if there are problems.
    """
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
        found: dict[Problem, None] = {}
        for options, context in product((config, *chosen.later), contexts):
            found |= dict.fromkeys(component.problems(options, context))
    # Code of a plugin may raise anything.
    except Exception as error:
        called = f"`{called}` of `{chosen.type}`"
        report_failure(chosen, called, error, chosen.installed, problems)
        return False
    for problem in found:
        steps, origin, _ = find(chosen.node, problem.option.split("."))
        path = f"{chosen.shown_path}.{problem.option}" if problem.option else chosen.source
        problems.add(origin if steps else chosen.origin, path, problem.reason, problem.fix)
    return True


def _without_idle_sublayers(draft: Draft, problems: Problems) -> Parts:
    """Remove each sublayer for which its decoder layer has no slot; return the other components.

    A removed sublayer is reported if the recipe sets it for this one layer. A sublayer that the
    recipe sets for all layers is reported only if no layer uses it.
    """
    kept = dict(draft.parts)
    layers: dict[KeyPath, Any] = {}
    for index in range(draft.dims.depth):
        path = layer_place(index, "layer")
        layers[path[:-1]] = kept[path]
    read = set().union(*(layer.component.sublayers for layer in layers.values()))
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
                reason = "a decoder of depth 0 has no layers, so nothing uses this component"
                _report_idle(template, reason, problems)
    return kept


def _report_idle(idle: Chosen, reason: str, problems: Problems) -> None:
    # A default is not a mistake of the user.
    if idle.node:
        fix = f"remove `{idle.slot}`, or write `{idle.slot}: null` if a base recipe sets it"
        problems.add(idle.origin, idle.source, reason, fix)


def _contradictions(draft: Draft, parts: Parts) -> Iterator[tuple[KeyPath, str, str]]:
    """Yield path, reason and fix for each setting that contradicts the components."""
    settings = draft.settings
    encoder: Any = parts["model", "encoder"]
    # Tuning fits features, so the encoder must recompute keys and values from them.
    if settings.evaluation.tuning == "latents" and not encoder.component.tunable:
        known: dict[str, Any] = draft.registry.components("encoder")
        others = " or ".join(f"`{name}`" for name in sorted(known) if known[name].tunable)
        reason = f"`{encoder.type}` at model.encoder has no latents to tune"
        fix = f"set evaluation.tuning to `queries`, or use {others} in the slot `encoder`"
        yield ("evaluation", "tuning"), reason, fix
    if settings.training.judge_inputs:
        path = ("training", "judge_inputs")
        fix = "set training.judge_inputs to false; evaluations do not read it"
        # A loss would compare renderings from moved cameras with photos from true ones.
        if settings.views.pose_noise:
            reason = "judge_inputs needs exact input cameras, but views.pose_noise moves them"
            yield path, reason, fix
        objective: Any = parts["objective",]
        if not objective.component.judges_inputs:
            reason = f"`{objective.type}` predicts one moment, but input views show other moments"
            yield path, reason, fix
    if ("data",) in parts and not any(path[0] == "losses" for path in parts):
        reason = "a recipe with data needs at least one loss to train"
        yield ("losses",), reason, "add one under `losses`, or remove the data with `data: null`"
    # Resolved recipes contain the default, which must stay valid.
    default = DecoderSettings().layer_scale
    layers: list[Any] = [parts[layer_place(index, "layer")] for index in range(draft.dims.depth)]
    read = any(layer.component.reads_layer_scale for layer in layers)
    if not read and settings.model.decoder.layer_scale != default:
        names = " and ".join(sorted({f"`{layer.type}`" for layer in layers}))
        reason = f"{names or 'a decoder of depth 0'} does not read layer_scale, so it has no effect"
        fix = f"remove layer_scale, or write `{inline(default)}` (the default) if a base sets it"
        yield (*DECODER, "layer_scale"), reason, fix


def check_flow(parts: Parts, depth: int, registry: Registry, problems: Problems) -> None:
    """Report fields that a component reads before they are written, or reads as the wrong type."""
    state: dict[str, tuple[FieldSpec, Chosen]] = {}
    for turns, decodes in _execution_order(parts, depth):
        # The next layer does not see fields that are decoded from this one.
        fields = dict(state) if decodes else state
        for chosen in turns:
            needed = chosen.component.fields_read(chosen.config)
            missing = {name: spec for name, spec in needed.items() if name not in fields}
            if missing:
                reason, fix = _unmet(missing, chosen, parts, registry)
                problems.add(chosen.origin, chosen.source, reason, fix)
            for name in needed.keys() - missing.keys():
                written, writer = fields[name]
                if written != needed[name]:
                    reason = (
                        f"`{chosen.type}` reads {name} as {needed[name]}, but `{writer.type}` at "
                        f"{writer.shown_path} ({writer.chosen_at}) writes it as {written}"
                    )
                    fix = f"change options of `{chosen.type}` or `{writer.type}` until they agree"
                    problems.add(chosen.origin, chosen.source, reason, fix)
            provided = chosen.component.fields_written(chosen.config)
            # A component that changes an unwritten field does not provide it.
            fields |= {n: (spec, chosen) for n, spec in provided.items() if n not in missing}


def _execution_order(parts: Parts, depth: int) -> Iterator[tuple[list[Chosen], bool]]:
    """Yield groups of components in the order of a training step, each group with a flag.

    The flag is True for the components that decode a layer and compute its losses.
    """
    supervision: Any = parts["model", "supervision"]
    # A supervised layer is decoded and judged right after it.
    decoded = {depth, *supervision.component(supervision.config).weights()}
    decode = [parts["model", name] for name in ("head", "centers", "renderer")]
    decode += [part for path, part in parts.items() if path[0] in ("losses", "objective")]
    yield [parts["model", "encoder"], parts["model", "queries"]], False
    for layer in range(depth + 1):
        places = [layer_place(layer - 1, name) for name in LAYER_SLOTS]
        yield [parts[place] for place in places if place in parts], False
        if layer in decoded:
            yield decode, True
    yield [parts["model", "feedback"]], False


def _unmet(missing: Fields, reader: Chosen, parts: Parts, registry: Registry) -> tuple[str, str]:
    """Return reason and fix for fields (`missing`) that `reader` reads before they are written."""
    named = " and ".join(f"{name} ({spec})" for name, spec in missing.items())
    reason = f"`{reader.type}` needs {named}, which no earlier component provides"
    for name in missing:
        late = [part for part in parts.values() if name in _offered(part.component, part.config)]
        if late:
            reason += f"; `{late[0].type}` at {late[0].shown_path} provides {name} too late"
    # The line helps users who replaced a component that provided the fields.
    now = {part.slot: f"`{part.type}`, {part.chosen_at}" for part in parts.values()}
    known = [
        f"`{kind}` in the slot `{slot}` (now {now.get(slot, 'empty')})"
        for slot in takewhile(lambda slot: slot != reader.slot, SLOTS)
        for kind, component in registry.components(slot).items()
        if missing.keys() <= _offered(component, default_config(component)).keys()
    ]
    if known:
        return reason, f"use {' or '.join(known)} with default options"
    return reason, f"use or install a component that provides {' and '.join(missing)}"


def _offered(component: type[Component], config: ComponentConfig | None) -> Fields:
    """Return the fields that `component` writes and does not read; no fields if its code fails."""
    with suppress(Exception):
        assert config is not None
        given = component.fields_read(config)
        return {n: spec for n, spec in component.fields_written(config).items() if n not in given}
    return {}


def keys_are_read(parts: Parts) -> bool:
    """Return whether any component reads keys or values of the image memory."""
    wanted = {"memory.keys", "memory.values"}
    return any(wanted & part.component.fields_read(part.config).keys() for part in parts.values())


def idle_fields(parts: Parts) -> Iterator[str]:
    """Yield a warning for each learnable field of queries that only refinements read."""
    read = set[str]()
    for path, part in parts.items():
        # A refinement reads the fields that it updates; that alone does not use them.
        if path[:-1] != DECODER and not issubclass(part.component, Refinement):
            read.update(part.component.fields_read(part.config))
    queries = parts["model", "queries"]
    for name, spec in _offered(queries.component, queries.config).items():
        if name not in read and spec.dtype.is_floating_point:
            yield (
                f"nothing reads {name} of `{queries.type}` at model.queries, so learning it "
                "has no effect"
            )


def unfinished(parts: Parts, steps: int) -> Iterator[str]:
    """Yield a warning for each schedule that still changes after `steps`, where training ends."""
    # Once for the template of a decoder, not for each layer.
    for part in {part.source: part for part in parts.values()}.values():
        for option, schedule in part.schedules.items():
            last = max(schedule.corners, default=0)
            if last > steps:
                changes = f"{part.shown_path}.{option} changes until step {last}"
                yield f"{changes}, but training ends at step {steps}"
