"""requires and provides, followed in the order in which a forward pass runs."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Any, Literal, TypeAlias, get_args, get_origin

from pydantic_core import PydanticUndefined, to_jsonable_python

from qgs.composer.decode import Chosen
from qgs.composer.errors import Problems
from qgs.composer.nodes import KeyPath, MapNode, find
from qgs.composer.registry import Registry, component_error, component_failure, default_config
from qgs.composer.slots import LAYER_SLOTS, SUBLAYER_SLOTS
from qgs.composer.yaml_text import inline
from qgs.contracts import (
    GAUSSIAN_FIELDS,
    MEMORY_FIELDS,
    DecoderLayer,
    Encoder,
    Head,
    Queries,
    Refinement,
    Renderer,
    Supervision,
)
from qgs.contracts.component import (
    Component,
    ComponentConfig,
    Fields,
    FieldSpec,
    Problem,
    RecipeContext,
)

Parts: TypeAlias = Mapping[KeyPath, Chosen | None]
"""What stands at each place; None for a component that could not be decoded."""

_FLOW = ("encoder", "queries", *LAYER_SLOTS, "head", "centers", "renderer", "losses", "objective")
"""Slots that read or write fields, in the order in which a layer's prediction is made."""


def check_options(chosen: Chosen, context: RecipeContext, problems: Problems) -> bool:
    """Report what is wrong with a component's options; whether its declarations can be read."""
    component, config, place = chosen.component, chosen.config, chosen.place
    asked, failure, cause = "fields_read", None, None
    try:
        dict(component.fields_read(config))
        asked = "fields_written"
        provided = component.fields_written(config)
        beyond = provided.keys() - _writable(component, provided)
        if issubclass(component, Supervision):
            asked = "weights"
            dict(component(config).weights())
        asked = "problems"
        found = list(component.problems(config, context))
        for later in chosen.later:
            found += [p for p in component.problems(later, context) if p not in found]
        odd = [type(problem).__name__ for problem in found if not isinstance(problem, Problem)]
        if odd:
            raise TypeError(f"it gives {odd[0]}, not qgs.contracts.Problem")
        if beyond:
            fault = (
                f"`{chosen.type}` says that it provides {', '.join(beyond)}, which a component of "
                f"the slot `{component.slot}` has no way to write"
            )
            failure = component_error(chosen.installed, fault)
    except Exception as error:
        failure, cause = component_failure(chosen.type, asked, error, chosen.installed), error
    if failure:
        problems.add(place.origin, chosen.path, failure.reason, failure.fix, cause)
        return False
    for problem in found:
        node = place.node if isinstance(place.node, MapNode) else MapNode(place.origin)
        steps, origin, _ = find(node, problem.option.split("."))
        path = f"{chosen.path}.{problem.option}" if problem.option else chosen.path
        problems.add(origin if steps else place.origin, path, problem.reason, problem.fix)
    return True


def _writable(component: type[Component], provided: Fields) -> Collection[str]:
    """Names of the fields among `provided` that a component of this slot can write."""
    if issubclass(component, Queries | DecoderLayer | Refinement):  # fields of a state
        others = "memory.", "gaussians.", "rendering."
        return [name for name in provided if not name.startswith(others)]
    if issubclass(component, Encoder | Head):
        return MEMORY_FIELDS if issubclass(component, Encoder) else GAUSSIAN_FIELDS
    return Renderer.fields_written(Renderer.Config()) if issubclass(component, Renderer) else ()


def without_idle_sublayers(parts: Parts, depth: int, problems: Problems) -> Parts:
    """`parts` without what stands in slots that no layer has; what is written there is reported.

    A template that some layers read is idle in none. Around a layer that could not be decoded
    nothing is known to be idle.
    """
    kept, told = dict(parts), set[str]()
    decoder = ("model", "decoder")
    places = [(*decoder, "layers", str(index)) for index in range(depth)]
    classes: list[Any] = [part.component for place in places if (part := parts[(*place, "layer")])]
    read = {(*decoder, name) for component in classes for name in component.sublayers}
    for place in places:
        layer = parts[(*place, "layer")]
        if layer is None:
            continue
        for name in _absent_sublayers(layer):
            idle = kept.pop((*place, name))
            if idle and idle.place.source not in read and idle.path not in told:
                told.add(idle.path)
                reason = f"`{layer.type}` ({layer.chosen_at}) has no slot `{name}`"
                _report_idle(idle, name, reason, problems)
    for name in LAYER_SLOTS:
        if not any((*place, name) in kept for place in places):
            template = kept.pop((*decoder, name))
            if template and not depth:
                reason = "a decoder of depth 0 has no layers, so nothing reads it"
                _report_idle(template, name, reason, problems)
    return kept


def _absent_sublayers(layer: Chosen) -> list[str]:
    """Slots of other decoder layers that this one has not."""
    component: Any = layer.component
    return [name for name in SUBLAYER_SLOTS if name not in component.sublayers]


def _report_idle(idle: Chosen, name: str, reason: str, problems: Problems) -> None:
    """Report what a recipe writes into the slot `name`, where nothing reads it."""
    if idle.place.node is not None:
        fix = f"remove it; `{name}: null` drops one that is inherited"
        problems.add(idle.place.origin, idle.path, reason, fix)


def check_flow(parts: Parts, depth: int, registry: Registry, problems: Problems) -> None:
    """Report fields that are read before they are written, or not as they are written.

    After a component that could not be decoded, which might have provided it, nothing is missing.
    What is missing at one place of a recipe is told once, not for every layer made from it.
    """
    steps = list(_execution_order(parts, depth))
    told, whole = set[tuple[str, ...]](), True
    chosen_parts = [part for part in parts.values() if part]  # asked once, not for every layer
    needs = {id(part): part.component.fields_read(part.config) for part in chosen_parts}
    gives = {id(part): part.component.fields_written(part.config) for part in chosen_parts}
    state: dict[str, tuple[FieldSpec, Chosen]] = {}
    branch, branch_layer = dict(state), None
    for position, (chosen, layer) in enumerate(steps):
        if layer is not None and layer != branch_layer:
            branch, branch_layer = dict(state), layer
        if chosen is None:
            whole = False
            continue
        fields = state if layer is None else branch
        origin, needed = chosen.place.origin, needs[id(chosen)]
        missing = {name: spec for name, spec in needed.items() if name not in fields}
        if missing and whole and (key := (chosen.path, *missing)) not in told:
            told.add(key)
            by_path = {step.path: step for step, _ in steps[:position] if step}
            before = list(by_path.values())
            after = list({step.path: step for step, _ in steps[position + 1 :] if step}.values())
            # One change that meets them all, or changes for each of them.
            joint = _fixes(missing, chosen, before, registry)
            for group in [missing] if joint else [{name: missing[name]} for name in missing]:
                fixes = joint or _fixes(group, chosen, before, registry)
                problems.add(origin, chosen.path, *_unmet(group, chosen, fixes, after))
        for name in needed.keys() - missing.keys():
            if fields[name][0] != needed[name]:
                reason, fix = _mismatch(name, needed[name], chosen, *fields[name])
                problems.add(origin, chosen.path, reason, fix)
        provided = gives[id(chosen)].items()
        fields |= {name: (spec, chosen) for name, spec in provided if name not in missing}


def keys_are_read(parts: Mapping[KeyPath, Chosen]) -> bool:
    """Whether a component requires keys or values of the image memory."""
    read = {name for part in parts.values() for name in part.component.fields_read(part.config)}
    return not read.isdisjoint({"memory.keys", "memory.values"})


def idle_fields(parts: Mapping[KeyPath, Chosen]) -> Iterator[str]:
    """Fields that queries start with and nothing reads but refinements, which only go on with them.

    One sentence each, with what would do without the field. Those that cannot be learnt, such as
    of bool, are not meant.
    """
    used = {path: part for path, part in parts.items() if path[:-1] != ("model", "decoder")}
    read = set[str]()
    for part in used.values():
        if not issubclass(part.component, Refinement):
            read |= part.component.fields_read(part.config).keys()
    keepers = [c for c in used.values() if issubclass(c.component, Queries | Refinement)]
    queries = parts["model", "queries"]
    for name, spec in _offers(queries.component, queries.config).items():
        if name in read or not spec.dtype.is_floating_point:
            continue
        changes = [
            f"set `{keeper.path}.{option}: {value}`"
            for keeper in {keeper.path: keeper for keeper in keepers}.values()
            for option, value, config in variants(keeper.config)
            if name in keeper.component.fields_written(keeper.config)
            if name not in keeper.component.fields_written(config)
        ]
        advice = f"; to do without it, {' and '.join(changes)}" if changes else ""
        yield (
            f"nothing reads {name}, which `{queries.type}` at model.queries "
            f"provides: what is learnt of it has no effect{advice}"
        )


def unfinished(parts: Mapping[KeyPath, Chosen], steps: int, seconds: float | None) -> Iterator[str]:
    """Schedules that a training of `steps` steps, or of `seconds`, leaves before their end."""
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


def _unmet(
    missing: Fields, reader: Chosen, fixes: Mapping[str, Chosen | None], after: Sequence[Chosen]
) -> tuple[str, str]:
    """Reason and fix where nothing before `reader` provides what it needs; fixes: see `_fixes`."""
    named = " and ".join(f"{name} ({spec})" for name, spec in missing.items())
    reason = f"`{reader.type}` needs {named}, which nothing before it provides"
    for other in {other.path: other for other in fixes.values() if other}.values():
        reason += f"; {other.path} is `{other.type}` ({other.chosen_at})"
    for name in missing:
        late = next((c for c in after if name in _offers(c.component, c.config)), None)
        if late:
            what = "it" if len(missing) == 1 else name
            reason += f"; `{late.type}` at {late.path} ({late.chosen_at}) provides {what} too late"
    install = f"install a plugin with a component that provides {next(iter(missing))}"
    return reason, ", or ".join(fixes) or install


def _fixes(
    missing: Fields, reader: Chosen, before: Sequence[Chosen], registry: Registry
) -> dict[str, Chosen | None]:
    """Changes that provide all of `missing`, and the component that each changes or replaces."""
    fixes: dict[str, Chosen | None] = {}
    for earlier in before:
        for option, value, config in variants(earlier.config, ()):
            if missing.keys() <= _offers(earlier.component, config).keys():
                fixes[f"set `{earlier.path}.{option}: {value}` on `{earlier.type}`"] = earlier
    if not fixes:
        standing = {chosen.place.slot.name: chosen for chosen in before}
        for slot in _FLOW[: _FLOW.index(reader.place.slot.name)]:
            for kind, component in registry.components(slot).items():
                default, there = default_config(component), standing.get(slot)
                if default is None:
                    continue
                plain = " with its default options" if there and there.type == kind else ""
                others = ((f" with `{o}: {v}`", config) for o, v, config in variants(default))
                for words, config in ((plain, default), *others):
                    if missing.keys() <= _offers(component, config).keys():
                        fixes[f"use `{kind}`{words} in the slot `{slot}`"] = there
                        break
    for option, value, config in variants(reader.config, ()):
        with suppress(Exception):  # what fails with this option is not suggested
            if not missing.keys() & reader.component.fields_read(config).keys():
                names = " and no ".join(missing)
                fixes[f"set `{reader.path}.{option}: {value}`, which needs no {names}"] = None
    return fixes


def _offers(component: type[Component], config: ComponentConfig) -> Fields:
    """What `component` provides with `config` without needing it; nothing where its code fails."""
    with suppress(Exception):
        given = component.fields_read(config)
        return {n: spec for n, spec in component.fields_written(config).items() if n not in given}
    return {}


def _mismatch(
    name: str, spec: FieldSpec, reader: Chosen, found: FieldSpec, writer: Chosen
) -> tuple[str, str]:
    """Reason and fix where `reader` reads the field `name` otherwise than it is written."""
    reason = (
        f"`{reader.type}` reads {name} as {spec}, "
        f"`{writer.type}` at {writer.path} ({writer.chosen_at}) writes it as {found}"
    )
    ours, theirs = reader.config.model_dump(mode="json"), writer.config.model_dump(mode="json")
    differing = [o for o in ours if o in theirs and ours[o] != theirs[o]]
    shared = {option: getattr(writer.config, option) for option in differing}
    if _asked(name, reader, reader.config.model_copy(update=shared)) == found and shared:
        words = ", ".join(f"{option}: {inline(theirs[option])}" for option in differing)
        return reason, f"set `{words}` on `{reader.type}`, as on `{writer.type}`"
    numbers = [size for size in found.shape if isinstance(size, int)]
    fixes = [
        f"set `{reader.path}.{option}: {value}` on `{reader.type}`"
        for option, value, config in variants(reader.config, numbers)
        if _asked(name, reader, config) == found
    ]
    other = f"choose another component than `{reader.type}` or `{writer.type}`"
    return reason, ", or ".join(fixes) or other


def _asked(name: str, reader: Chosen, config: ComponentConfig) -> FieldSpec | None:
    """How `reader` would read the field `name` with `config`; None if it would not, or fails."""
    with suppress(Exception):
        return reader.component.fields_read(config).get(name)
    return None


def variants(
    config: ComponentConfig, sizes: Sequence[int] | None = None
) -> Iterator[tuple[str, str, ComponentConfig]]:
    """`config` with one choice made otherwise: option, new value in YAML, new config.

    With `sizes` other options are also set to their defaults, whole numbers to each of the sizes.
    """
    for option, field in type(config).model_fields.items():
        choices: Sequence[object] = ()
        if field.annotation is bool:
            choices = True, False
        elif get_origin(field.annotation) is Literal:
            choices = get_args(field.annotation)
        elif sizes is not None:
            numbers = sizes if field.annotation in (int, int | None) else ()
            choices = [field.default, *(n for n in numbers if n != field.default)]
        for choice in choices:
            if choice not in (getattr(config, option), PydanticUndefined):
                new = config.model_copy(update={option: choice})
                yield option, inline(to_jsonable_python(choice)), new


def fits(shape: tuple[int, ...], wanted: Sequence[int | str | None]) -> bool:
    """Whether `shape` has the sizes that are `wanted`; one that is no number may be any."""
    return len(shape) == len(wanted) and all(
        not isinstance(size, int) or size == given
        for size, given in zip(wanted, shape, strict=True)
    )
