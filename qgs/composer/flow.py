"""requires and provides, followed in the order in which a forward pass runs."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeVar, get_args, get_origin

from torch import nn

from qgs.composer.decode import Chosen
from qgs.composer.errors import Problems
from qgs.composer.nodes import KeyPath
from qgs.composer.registry import (
    InstalledPlugin,
    Registry,
    component_error,
    component_failure,
    default_config,
    place_of,
)
from qgs.composer.slots import LAYER_SLOTS
from qgs.composer.yaml_text import dump
from qgs.contracts import (
    MEMORY_FIELDS,
    Component,
    ComponentConfig,
    Encoder,
    Fields,
    FieldSpec,
    Problem,
    Queries,
    RecipeContext,
    Refinement,
    Renderer,
    Supervision,
)
from qgs.types import QueryState


def refuse_unkeepable(chosen: Chosen, provided: Fields) -> None:
    """Raise PluginError if `chosen` provides what no component of its slot can write."""
    writable = _writable(chosen.component)
    beyond = [] if writable is None else [name for name in provided if name not in writable]
    if beyond:
        raise component_error(
            chosen.installed,
            f"`{chosen.type}` says that it provides {', '.join(beyond)}, which a component of the "
            f"slot `{chosen.component.slot}` has no way to write",
        )


def hold_to_promise(module: nn.Module, chosen: Chosen) -> None:
    """Make `module` raise PluginError when it does not give the state that it must.

    That has the fields that it provides, and those of the state that it was given.
    """
    if issubclass(chosen.component, Queries | Refinement):
        provided = dict(chosen.component.provides(chosen.config))
        place = place_of(chosen.component.forward)
        module.register_forward_hook(_Promise(chosen.type, chosen.installed, provided, place))


def _writable(component: type[Component]) -> Collection[str] | None:
    """Names of the fields that a component of this slot can write; None for any."""
    if issubclass(component, Queries | Refinement):
        return None
    if issubclass(component, Encoder):
        return MEMORY_FIELDS
    if issubclass(component, Renderer):
        return Renderer.provides(Renderer.Config())
    return ()


@dataclass(frozen=True)
class _Promise:
    """A forward hook that looks for the `provided` fields in the state returned."""

    type: str
    installed: InstalledPlugin
    provided: Fields
    place: str

    def __call__(self, module: nn.Module, arguments: Any, state: Any) -> None:
        if not isinstance(state, QueryState):
            raise self._broken(f"returns {type(state).__name__}, not a QueryState")
        found = ", ".join(state.fields) or "no field at all"
        for name, spec in self.provided.items():
            says = f"says that it provides {name} ({spec}), but"
            if name not in state.fields:
                raise self._broken(f"{says} the state that it returns has {found}")
            shape = tuple(state.fields[name].shape[2:])
            if not fits(shape, spec.shape):
                raise self._broken(f"{says} it returns one of trailing shape {shape}")
        for given in arguments:
            lost = [n for n in getattr(given, "fields", ()) if n not in state.fields]
            if lost:
                raise self._broken(
                    f"loses {', '.join(lost)}: the state that it returns has {found}; "
                    "`state.replace(...)` keeps what it does not change"
                )

    def _broken(self, what: str) -> Exception:
        return component_error(self.installed, f"`{self.type}` {what}", self.place)


def fits(shape: tuple[int, ...], wanted: Sequence[int | str | None]) -> bool:
    """Whether `shape` has the sizes that are `wanted`; one that is no number may be any."""
    return len(shape) == len(wanted) and all(
        not isinstance(size, int) or size == given
        for size, given in zip(wanted, shape, strict=True)
    )


T = TypeVar("T")


def check_declarations(chosen: Chosen, context: RecipeContext) -> list[Problem]:
    """The `problems` of a component whose declarations can all be read.

    Raises PluginError, which names the distribution, for one whose code fails.
    """

    def ask(name: str, question: Callable[[], T]) -> T:
        try:
            return question()
        except Exception as error:
            raise component_failure(chosen.type, name, error, chosen.installed) from error

    component, config = chosen.component, chosen.config
    ask("requires", lambda: dict(component.requires(config)))
    provided = ask("provides", lambda: dict(component.provides(config)))
    refuse_unkeepable(chosen, provided)
    if issubclass(component, Supervision):
        ask("weights", lambda: dict(component(config).weights()))
    return ask("problems", lambda: _listed(component.problems(config, context)))


def offers(component: type[Component], config: ComponentConfig) -> Fields:
    """What `component` would provide by itself with `config`: not what it needs to be given.

    Nothing for options with which the component cannot be asked: a suggestion must be sound.
    """
    try:
        given = component.requires(config)
        return {n: spec for n, spec in component.provides(config).items() if n not in given}
    except Exception:
        return {}


def needs(component: type[Component], config: ComponentConfig) -> Fields | None:
    """What `component` would require with `config`; None where it cannot be asked."""
    try:
        return component.requires(config)
    except Exception:
        return None


def _listed(problems: Iterable[Problem]) -> list[Problem]:
    found = list(problems)
    for problem in found:
        if not isinstance(problem, Problem):
            raise TypeError(f"it gives {type(problem).__name__}, not qgs.contracts.Problem")
    return found


_FLOW = ("encoder", "queries", *LAYER_SLOTS, "head", "centers", "renderer", "losses")
"""Slots that read or write fields, in the order in which a layer's prediction is made."""


def fix_unmet(missing: Fields, chosen: Chosen, before: Sequence[Chosen], registry: Registry) -> str:
    """What to do when `chosen` needs fields that nothing `before` it provides.

    One change that meets them all, or changes for each of them.
    """
    fixes = dict.fromkeys(
        f"set `{earlier.written_at}.{option}: {value}` on `{earlier.type}`"
        for earlier in before
        for option, value, config in variants(earlier.config)
        if missing.keys() <= offers(earlier.component, config).keys()
    )
    if not fixes:
        fixes = dict.fromkeys(_installed_providers(missing, chosen.place.slot.name, registry))
    for option, value, config in variants(chosen.config):
        needed = needs(chosen.component, config)
        if needed is not None and not missing.keys() & needed.keys():
            names = " and no ".join(missing)
            fixes[f"set `{chosen.written_at}.{option}: {value}`, which needs no {names}"] = None
    if fixes:
        return ", or ".join(fixes)
    if len(missing) == 1:
        return f"install a plugin with a component that provides {next(iter(missing))}"
    return "; ".join(
        f"for {name}: {fix_unmet({name: spec}, chosen, before, registry)}"
        for name, spec in missing.items()
    )


def fix_mismatch(reader: Chosen, writer: Chosen) -> str:
    """What to do when two components disagree about a field."""
    ours, theirs = reader.config, writer.config
    differing = [
        option
        for option in type(ours).model_fields
        if option in type(theirs).model_fields and getattr(ours, option) != getattr(theirs, option)
    ]
    if not differing:
        return f"choose another component than `{reader.type}` or `{writer.type}`"
    words = [f"{option}: {_word(getattr(theirs, option))}" for option in differing]
    return f"set `{', '.join(words)}` on `{reader.type}`, as on `{writer.type}`"


def _installed_providers(missing: Fields, reader: str, registry: Registry) -> Iterator[str]:
    """Components that provide the fields by themselves, in slots that run before `reader`."""
    for slot in _FLOW[: _FLOW.index(reader)]:
        for kind, component in registry.components(slot).items():
            for note, config in _default_configs(component):
                if missing.keys() <= offers(component, config).keys():
                    yield f"use `{kind}`{note} in the slot `{slot}`"
                    break


def _default_configs(component: type[Component]) -> Iterator[tuple[str, ComponentConfig]]:
    config = default_config(component)
    if config is None:
        return
    yield "", config
    for option, value, variant in variants(config):
        yield f" with `{option}: {value}`", variant


def variants(config: ComponentConfig) -> Iterator[tuple[str, str, ComponentConfig]]:
    """`config` with one choice made otherwise: option, new value in YAML, new config."""
    for option, field in type(config).model_fields.items():
        choices: tuple[object, ...] = ()
        if field.annotation is bool:
            choices = (True, False)
        elif get_origin(field.annotation) is Literal:
            choices = get_args(field.annotation)
        for choice in choices:
            if choice != getattr(config, option):
                yield option, _word(choice), config.model_copy(update={option: choice})


def _word(value: object) -> str:
    return dump(value).removesuffix("\n").removesuffix("\n...")


@dataclass(frozen=True)
class Step:
    """One component's turn. layer: None in the decoder's own course, else the decoded layer."""

    chosen: Chosen | None
    layer: int | None = None


def decoded_layers(chosen: Chosen | None, depth: int) -> set[int]:
    """Numbers of the layers that are decoded: the supervised ones and the last."""
    if chosen is None:
        return {depth}
    supervision = chosen.component(chosen.config)  # type: ignore[call-arg]
    assert isinstance(supervision, Supervision)
    return {*supervision.weights(), depth}


def execution_order(
    parts: Mapping[KeyPath, Chosen | None], depth: int, decoded: set[int]
) -> Iterator[Step]:
    """Every component's turn in a training step."""
    yield Step(parts["model", "encoder"])
    yield Step(parts["model", "queries"])
    for index in range(depth):
        for name in LAYER_SLOTS:
            yield Step(parts["model", "decoder", "layers", str(index), name])
        if index + 1 in decoded:
            for name in ("head", "centers", "renderer"):
                yield Step(parts["model", name], index + 1)
            for path, loss in parts.items():
                if path[0] == "losses":
                    yield Step(loss, index + 1)


def check_flow(steps: Sequence[Step], registry: Registry, problems: Problems) -> None:
    """Report fields that are read before they are written, or not as they are written.

    After a component that could not be decoded nothing is reported as missing: it might have
    provided it.
    """
    written: dict[str, tuple[FieldSpec, Chosen]] = {}
    branch, layer, uncertain = dict(written), None, False
    for position, step in enumerate(steps):
        if step.layer is None:
            fields = written
        else:
            if step.layer != layer:
                branch, layer = dict(written), step.layer
            fields = branch
        if step.chosen is None:
            uncertain = True
            continue
        _check_step(steps, position, fields, uncertain, registry, problems)
        lacking = set(_requires(step.chosen)) - set(fields)
        for name, spec in step.chosen.component.provides(step.chosen.config).items():
            if name not in lacking:
                fields[name] = (spec, step.chosen)


def _check_step(
    steps: Sequence[Step],
    position: int,
    fields: Mapping[str, tuple[FieldSpec, Chosen]],
    uncertain: bool,
    registry: Registry,
    problems: Problems,
) -> None:
    chosen = steps[position].chosen
    assert chosen is not None
    missing = {n: spec for n, spec in _requires(chosen).items() if n not in fields}
    if missing and not uncertain:
        before = [step.chosen for step in steps[:position] if step.chosen]
        after = [step.chosen for step in steps[position + 1 :] if step.chosen]
        fix = fix_unmet(missing, chosen, before, registry)
        problems.add(
            chosen.place.origin, chosen.written_at, _why_unmet(missing, chosen, after), fix
        )
    for name, spec in _requires(chosen).items():
        if name in fields and fields[name][0] != spec:
            found, writer = fields[name]
            reason = (
                f"`{chosen.type}` reads {name} as {spec}, "
                f"`{writer.type}` at {writer.written_at} writes it as {found}"
            )
            problems.add(
                chosen.place.origin, chosen.written_at, reason, fix_mismatch(chosen, writer)
            )


def _why_unmet(missing: Fields, chosen: Chosen, after: Sequence[Chosen]) -> str:
    named = " and ".join(f"{name} ({spec})" for name, spec in missing.items())
    reason = f"`{chosen.type}` needs {named}, which nothing before it provides"
    for name in missing:
        later = next((c for c in after if _originates(c, name)), None)
        if later:
            what = "it" if len(missing) == 1 else name
            reason += f"; `{later.type}` at {later.written_at} provides {what} too late"
    return reason


def _requires(chosen: Chosen) -> Fields:
    return chosen.component.requires(chosen.config)


def _originates(chosen: Chosen, name: str) -> bool:
    """Whether `chosen` provides a field without needing it itself."""
    return name in chosen.component.provides(chosen.config) and name not in _requires(chosen)
