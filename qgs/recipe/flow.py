"""Fields that components require and provide, followed in the order of a forward pass."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Any, TypeAlias

from qgs.contracts import LAYER_SLOTS, SUBLAYER_SLOTS, Refinement, Supervision
from qgs.contracts.component import Component, ComponentConfig, Fields, FieldSpec, RecipeContext
from qgs.recipe.decode import Chosen
from qgs.recipe.errors import Problems
from qgs.recipe.registry import Registry, component_failure, default_config
from qgs.recipe.slots import AFTER_LAYERS
from qgs.recipe.yaml_text import KeyPath, MapNode, find

Parts: TypeAlias = Mapping[KeyPath, Chosen | None]
"""What stands at each place; None for a component that could not be decoded."""

_FLOW = ("encoder", "queries", *LAYER_SLOTS, *AFTER_LAYERS, "losses", "objective")
"""Slots that read or write fields, in the order in which a layer's prediction is made."""


def check_options(chosen: Chosen, context: RecipeContext, problems: Problems) -> bool:
    """Report what is wrong with a component's options; whether its declarations can be read."""
    component, config, place = chosen.component, chosen.config, chosen.place
    called = "fields_read"
    try:
        component.fields_read(config)
        called = "fields_written"
        component.fields_written(config)
        if issubclass(component, Supervision):
            called = "weights"
            component(config).weights()
        called = "problems"
        # A scheduled option must be valid at every extreme of its schedule.
        found = dict.fromkeys(
            problem
            for options in (config, *chosen.later)
            for problem in component.problems(options, context)
        )
    except Exception as error:  # code of a plugin
        failure = component_failure(chosen.type, called, error, chosen.installed)
        problems.add(place.origin, chosen.path, failure.reason, failure.fix, error)
        return False
    for problem in found:
        node = place.node if isinstance(place.node, MapNode) else MapNode(place.origin)
        steps, origin, _ = find(node, problem.option.split("."))
        path = f"{chosen.path}.{problem.option}" if problem.option else chosen.path
        problems.add(origin if steps else place.origin, path, problem.reason, problem.fix)
    return True


def without_idle_sublayers(parts: Parts, depth: int, problems: Problems) -> Parts:
    """`parts` without components in slots that no layer has; reports those written in the recipe.

    A template used by any layer is not reported; layers that failed to decode are skipped.
    """
    kept, reported = dict(parts), set[str]()

    def report(idle: Chosen | None, name: str, reason: str) -> None:
        if idle and idle.place.node is not None and idle.path not in reported:
            reported.add(idle.path)
            fix = f"remove it; `{name}: null` drops one that is inherited"
            problems.add(idle.place.origin, idle.path, reason, fix)

    decoder = ("model", "decoder")
    places = [(*decoder, "layers", str(index)) for index in range(depth)]
    classes: list[Any] = [part.component for place in places if (part := parts[(*place, "layer")])]
    read = {(*decoder, name) for component in classes for name in component.sublayers}
    for place in places:
        layer = parts[(*place, "layer")]
        if layer is None:
            continue
        component: Any = layer.component
        for name in SUBLAYER_SLOTS:
            if name not in component.sublayers:
                idle = kept.pop((*place, name))
                if idle and idle.place.source not in read:
                    report(idle, name, f"`{layer.type}` ({layer.chosen_at}) has no slot `{name}`")
    for name in LAYER_SLOTS:
        if not any((*place, name) in kept for place in places):
            template = kept.pop((*decoder, name))
            if not depth:
                report(template, name, "a decoder of depth 0 has no layers, so nothing reads it")
    return kept


def check_flow(parts: Parts, depth: int, registry: Registry, problems: Problems) -> None:
    """Report fields that are read before they are written, or not as they are written.

    After a component that failed to decode, which might have provided it, nothing is missing. A
    template of the decoder is reported once, not for each of its layers.
    """
    steps = list(_execution_order(parts, depth))
    reported, complete = set[tuple[str, ...]](), True
    chosen_parts = [part for part in parts.values() if part]  # called once, not for every layer
    needs = {id(part): part.component.fields_read(part.config) for part in chosen_parts}
    gives = {id(part): part.component.fields_written(part.config) for part in chosen_parts}
    state: dict[str, tuple[FieldSpec, Chosen]] = {}
    branch, branch_layer = dict(state), None
    for position, (chosen, layer) in enumerate(steps):
        if layer is not None and layer != branch_layer:
            branch, branch_layer = dict(state), layer
        if chosen is None:
            complete = False
            continue
        fields = state if layer is None else branch
        origin, needed = chosen.place.origin, needs[id(chosen)]
        missing = {name: spec for name, spec in needed.items() if name not in fields}
        if missing and complete and (key := (chosen.path, *missing)) not in reported:
            reported.add(key)
            later = [step for step, _ in steps[position + 1 :] if step]
            problems.add(origin, chosen.path, *_unmet(missing, chosen, later, registry))
        for name in needed.keys() - missing.keys():
            written, writer = fields[name]
            if written != needed[name]:
                reason = (
                    f"`{chosen.type}` reads {name} as {needed[name]}, `{writer.type}` at "
                    f"{writer.path} ({writer.chosen_at}) writes it as {written}"
                )
                fix = f"change the options of `{chosen.type}` or `{writer.type}` until they agree"
                problems.add(origin, chosen.path, reason, fix)
        provided = gives[id(chosen)].items()
        fields |= {name: (spec, chosen) for name, spec in provided if name not in missing}


def keys_are_read(parts: Mapping[KeyPath, Chosen]) -> bool:
    """Whether a component requires keys or values of the image memory."""
    read = {name for part in parts.values() for name in part.component.fields_read(part.config)}
    return not read.isdisjoint({"memory.keys", "memory.values"})


def idle_fields(parts: Mapping[KeyPath, Chosen]) -> Iterator[str]:
    """A sentence for each learnable field of the queries that only refinements read."""
    used = [part for path, part in parts.items() if path[:-1] != ("model", "decoder")]
    readers = [part for part in used if not issubclass(part.component, Refinement)]
    read = {name for part in readers for name in part.component.fields_read(part.config)}
    queries = parts["model", "queries"]
    for name, spec in _offers(queries.component, queries.config).items():
        if name not in read and spec.dtype.is_floating_point:
            yield (
                f"nothing reads {name}, which `{queries.type}` at model.queries provides: what is "
                "learned of it has no effect"
            )


def unfinished(parts: Mapping[KeyPath, Chosen], steps: int, seconds: float | None) -> Iterator[str]:
    """A sentence for each schedule that goes on after `steps` steps, or may after `seconds`."""
    for part in {part.path: part for part in parts.values()}.values():
        for option, schedule in part.schedules.items():
            if (last := max(schedule.corners, default=0)) > steps:
                yield f"{part.path}.{option} changes until step {last}, training ends at {steps}"
            elif last and seconds is not None:
                yield (
                    f"{part.path}.{option} changes until step {last}, and training.seconds may end "
                    f"training before, after {seconds:g} s: schedules count steps"
                )


def _execution_order(parts: Parts, depth: int) -> Iterator[tuple[Chosen | None, int | None]]:
    """Every component's turn in a training step, and the layer that is decoded, else None.

    A decoded layer has a branch of its own: what its head writes is not there for the decoder.
    """
    decoded, chosen = {depth}, parts["model", "supervision"]
    if chosen is not None:
        supervision: Any = chosen.component
        decoded |= supervision(chosen.config).weights().keys()
    yield parts["model", "encoder"], None
    yield parts["model", "queries"], None
    for layer in range(depth + 1):
        for name in LAYER_SLOTS if layer else ():
            path = ("model", "decoder", "layers", str(layer - 1), name)
            if path in parts:
                yield parts[path], None
        if layer in decoded:
            for name in ("head", "centers", "renderer"):
                yield parts["model", name], layer
            judges = ("losses", "objective")
            yield from ((part, layer) for path, part in parts.items() if path[0] in judges)
    yield parts["model", "feedback"], None


def _unmet(
    missing: Fields, reader: Chosen, later: Sequence[Chosen], registry: Registry
) -> tuple[str, str]:
    """Reason and fix where no component before `reader` provides the fields that it requires."""
    named = " and ".join(f"{name} ({spec})" for name, spec in missing.items())
    reason = f"`{reader.type}` needs {named}, which nothing before it provides"
    for name in missing:
        late = next((c for c in later if name in _offers(c.component, c.config)), None)
        if late:
            reason += f"; `{late.type}` at {late.path} provides {name} too late"
    known = [
        f"`{kind}` in the slot `{slot}`"
        for slot in _FLOW[: _FLOW.index(reader.place.slot.name)]
        for kind, component in registry.components(slot).items()
        if missing.keys() <= _offers(component, default_config(component)).keys()
    ]
    install = f"use or install a component that provides {' and '.join(missing)}"
    return reason, f"use {' or '.join(known)} with default options" if known else install


def _offers(component: type[Component], config: ComponentConfig | None) -> Fields:
    """What `component` provides without requiring it; nothing where a plugin's code fails."""
    with suppress(Exception):
        assert config is not None
        given = component.fields_read(config)
        return {n: spec for n, spec in component.fields_written(config).items() if n not in given}
    return {}
