"""Fields that components require and provide, followed in the order of a forward pass."""

from collections.abc import Iterator, Mapping
from contextlib import suppress
from typing import Any

from qgs.contracts import LAYER_SLOTS, Refinement
from qgs.contracts.component import Component, ComponentConfig, Fields, FieldSpec
from qgs.recipe.decode import Chosen, Parts
from qgs.recipe.errors import Problems
from qgs.recipe.places import DECODER
from qgs.recipe.registry import Registry, default_config
from qgs.recipe.slots import AFTER_LAYERS
from qgs.recipe.yaml_text import KeyPath

_FLOW = ("encoder", "queries", *LAYER_SLOTS, *AFTER_LAYERS, "losses", "objective")
"""Slots that read or write fields, in the order in which a layer's prediction is made."""


def check_flow(parts: Parts, depth: int, registry: Registry, problems: Problems) -> None:
    """Report fields that are read before they are written, or not as they are written."""
    state: dict[str, tuple[FieldSpec, Chosen]] = {}
    for turns, decodes in _execution_order(parts, depth):
        # What is decoded of a layer is not there for the next one.
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
                        f"`{chosen.type}` reads {name} as {needed[name]}, `{writer.type}` at "
                        f"{writer.shown_path} ({writer.chosen_at}) writes it as {written}"
                    )
                    both = f"`{chosen.type}` or `{writer.type}`"
                    fix = f"change the options of {both} until they agree"
                    problems.add(chosen.origin, chosen.source, reason, fix)
            provided = chosen.component.fields_written(chosen.config)
            # Who changes a field that was never written has not provided it.
            fields |= {n: (spec, chosen) for n, spec in provided.items() if n not in missing}


def _execution_order(parts: Parts, depth: int) -> Iterator[tuple[list[Chosen], bool]]:
    """Components in the order of a training step; whether they decode and judge a layer."""
    supervision: Any = parts["model", "supervision"]
    # A supervised layer is decoded and judged right after it.
    decoded = {depth, *supervision.component(supervision.config).weights()}
    decode = [parts["model", name] for name in ("head", "centers", "renderer")]
    decode += [part for path, part in parts.items() if path[0] in ("losses", "objective")]
    yield [parts["model", "encoder"], parts["model", "queries"]], False
    for layer in range(depth + 1):
        places = [(*DECODER, "layers", str(layer - 1), name) for name in LAYER_SLOTS]
        yield [parts[place] for place in places if place in parts], False
        if layer in decoded:
            yield decode, True
    yield [parts["model", "feedback"]], False


def _unmet(missing: Fields, reader: Chosen, parts: Parts, registry: Registry) -> tuple[str, str]:
    """Reason and fix where no component before `reader` provides the fields that it requires."""
    named = " and ".join(f"{name} ({spec})" for name, spec in missing.items())
    reason = f"`{reader.type}` needs {named}, which nothing before it provides"
    for name in missing:
        late = [part for part in parts.values() if name in _offers(part)]
        if late:
            reason += f"; `{late[0].type}` at {late[0].shown_path} provides {name} too late"
    # Whoever replaced a component that provided them finds the line here.
    now = {part.slot: f"`{part.type}`, {part.chosen_at}" for part in parts.values()}
    known = [
        f"`{kind}` in the slot `{slot}` (now {now.get(slot, 'empty')})"
        for slot in _FLOW[: _FLOW.index(reader.slot)]
        for kind, component in registry.components(slot).items()
        if missing.keys() <= _offered(component, default_config(component)).keys()
    ]
    if known:
        return reason, f"use {' or '.join(known)} with default options"
    return reason, f"use or install a component that provides {' and '.join(missing)}"


def _offers(part: Chosen) -> Fields:
    return _offered(part.component, part.config)


def _offered(component: type[Component], config: ComponentConfig | None) -> Fields:
    """Fields that `component` provides without requiring them; none where a plugin's code fails."""
    with suppress(Exception):
        assert config is not None
        given = component.fields_read(config)
        return {n: spec for n, spec in component.fields_written(config).items() if n not in given}
    return {}


def keys_are_read(parts: Mapping[KeyPath, Chosen]) -> bool:
    """Return whether a component requires keys or values of the image memory."""
    read = {name for part in parts.values() for name in part.component.fields_read(part.config)}
    return not read.isdisjoint({"memory.keys", "memory.values"})


def idle_fields(parts: Mapping[KeyPath, Chosen]) -> Iterator[str]:
    """A sentence for each learnable field of the queries that only refinements read."""
    used = [part for path, part in parts.items() if path[:-1] != DECODER]
    # A refinement reads what it updates, which alone makes no use of it.
    readers = [part for part in used if not issubclass(part.component, Refinement)]
    read = {name for part in readers for name in part.component.fields_read(part.config)}
    queries = parts["model", "queries"]
    for name, spec in _offers(queries).items():
        if name not in read and spec.dtype.is_floating_point:
            yield (
                f"nothing reads {name}, which `{queries.type}` at model.queries provides: what is "
                "learned of it has no effect"
            )


def unfinished(parts: Mapping[KeyPath, Chosen], steps: int) -> Iterator[str]:
    """A sentence for each schedule that goes on after `steps` steps."""
    # Once for the template of a decoder, not for each layer.
    for part in {part.source: part for part in parts.values()}.values():
        for option, schedule in part.schedules.items():
            last = max(schedule.corners, default=0)
            if last > steps:
                changes = f"{part.shown_path}.{option} changes until step {last}"
                yield f"{changes}, training ends at {steps}"
