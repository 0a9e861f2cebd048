"""Decoding of a component's entry in a recipe: its class, and its options as a Config."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails, PydanticUndefinedType, to_jsonable_python

from qgs.contracts import Component, ComponentConfig, OptionError
from qgs.contracts.schedule import Schedule
from qgs.recipe.errors import Problems
from qgs.recipe.places import Place
from qgs.recipe.registry import InstalledPlugin, Registry
from qgs.recipe.slots import SLOTS, type_at
from qgs.recipe.yaml_text import KeyPath, MapNode, brief, find, inline
from qgs.tokengs.schedules import SCHEDULES
from qgs.wording import did_you_mean, nearest

ConfigT = TypeVar("ConfigT", bound=ComponentConfig)


@dataclass(frozen=True)
class Chosen(Place):
    """A component that a recipe chooses: its `type`, class, options, and the plugin that offers it.

    schedules: schedules of the options that change during training, by option.
    config: the options at step 0.
    later: the options at each later step at which a schedule may have an extreme value.
    """

    node: MapNode
    type: str
    component: type[Component]
    config: ComponentConfig
    later: Sequence[ComponentConfig]
    schedules: Mapping[str, Schedule]
    installed: InstalledPlugin

    @property
    def options(self) -> dict[str, Any]:
        """Options in the form of a recipe, where a schedule is a mapping."""
        written = {name: s.model_dump(mode="json") for name, s in self.schedules.items()}
        return self.config.model_dump(mode="json") | written

    def equals(self, other: Chosen) -> bool:
        """Return whether `other` is the same component with the same options."""
        return self.component is other.component and self.options == other.options

    @property
    def shown_path(self) -> str:
        """Dotted path at which the recipe sets this component."""
        return ".".join(self.source)

    @property
    def chosen_at(self) -> str:
        """File and line that set `type`; "default of the slot" if no line sets it."""
        return str(self.node.origins.get("type", "default of the slot"))


Parts = Mapping[KeyPath, Chosen]
"""Components by their paths in a recipe."""


def decode_place(place: Place, registry: Registry, problems: Problems) -> Chosen | None:
    """Return the component at `place` of a recipe; if invalid, add a problem and return None."""
    node = place.node
    if not isinstance(node, MapNode):
        reason = f"a component must be a mapping, got {brief(node)}"
        fix = "write `{type: PLUGIN/NAME, option: value}`"
        return problems.add(place.origin, place.source, reason, fix)
    name = type_at(node, place.path)
    known = registry.components(place.slot)
    if not isinstance(name, str) or name not in known:
        why = _why_no_component(name, place.slot, registry)
        origin = node.origins.get("type", place.origin)
        return why and problems.add(origin, (*place.source, "type"), *why)
    component = known[name]
    installed = registry.plugins[name.partition("/")[0]]
    try:
        found = _decode_options(component, node.without("type"), place.source, problems)
    except Exception as error:
        return report_failure(place, f"`Config` of `{name}`", error, installed, problems)
    if found is None:
        return None
    configs, schedules = found
    config, *later = configs
    at = (place.path, place.source, node, place.origin)
    return Chosen(*at, name, component, config, later, schedules, installed)


def report_failure(
    place: Place, called: str, error: Exception, installed: InstalledPlugin, problems: Problems
) -> None:
    """Add the problem that a plugin's code raised `error`.

    called: text that names this code in the message, such as "`Config` of `qgs/free`".
    """
    release = installed.released_as
    origin = f"the plugin `{installed.plugin.name}`{f' of {release}' if release else ''}"
    reason = f"{origin} fails: {called} raises {type(error).__name__}: {error}"
    fix = f"update or fix {release or 'it'}, or choose another component"
    problems.add(place.origin, place.source, reason, fix, error)


def _decode_options(
    component: type[Component], node: MapNode, path: KeyPath, problems: Problems
) -> tuple[list[ComponentConfig], dict[str, Schedule]] | None:
    """Return the options at step 0 and at each corner of a schedule, and the schedules by option.

    A corner is a step at which a schedule may have an extreme value. For invalid options, adds
    problems and returns None.
    """
    assert component.scheduled <= {*component.Config.model_fields}, component
    schedules: dict[str, Schedule] = {}
    steps = {0}
    for option, value, origin in node.entries():
        if option in component.scheduled and isinstance(value, MapNode):
            kind = str(value.get("schedule", ""))
            below = (*path, option)
            if kind not in SCHEDULES:
                reason = "a mapping is a schedule here, so `schedule` must name a known kind"
                fix = did_you_mean(kind, SCHEDULES, "schedules")
                at = value.origins.get("schedule", origin)
                return problems.add(at, (*below, "schedule"), reason, fix)
            schedule = decode_config(SCHEDULES[kind], value, below, problems)
            if schedule is None:
                return None
            schedules[option] = schedule
            steps.update(schedule.corners)
    configs = list[ComponentConfig]()
    # Between two corners a schedule is monotonic, so that no other step is beyond its limits.
    for step in sorted(steps):
        options = MapNode(node.origin, node.entries())
        for option, schedule in schedules.items():
            number = schedule.number(step)
            # Options that are integers refuse 2.0, so that integral numbers are written as 2.
            options[option] = int(number) if number.is_integer() else number
        config = decode_config(component.Config, options, path, problems)
        if config is None:
            return None
        configs.append(config)
    return configs, schedules


def _why_no_component(name: object, slot: str, registry: Registry) -> tuple[str, str] | None:
    """Return reason and fix for an unknown `type` in `slot`.

    Returns None if the type may belong to an unusable plugin, which is already reported.
    """
    known = registry.components(slot)
    choice = f"choose {', '.join(sorted(known))}"
    if not isinstance(name, str):
        # The slot has no default component.
        return f"`type` must name a component of the slot `{slot}`, got {brief(name)}", choice
    plugin, slash, _ = name.partition("/")
    if slash and plugin not in registry.plugins:
        # It may belong to an unusable plug-in, which is already reported.
        if not registry.complete:
            return None
        reason = f"`{name}` belongs to the plugin `{plugin}`, which this recipe does not use"
        return reason, f"add `plugins: [{plugin}]`; plugins of a base recipe stay"
    # Several slots may have the same name, such as `qgs/none`.
    for other in SLOTS:
        if name in registry.components(other):
            return f"`{name}` belongs in the slot `{other}`, not in `{slot}`", choice
    reason = f"there is no component `{name}` for the slot `{slot}`"
    return reason, did_you_mean(name, known, "installed components PLUGIN/NAME")


def decode_config(
    config: type[ConfigT], node: MapNode, path: KeyPath, problems: Problems
) -> ConfigT | None:
    """Decode the options in `node` at `path`; if any is invalid, add problems and return None."""
    options, faults = validated(config, node)
    for fault in faults:
        report(fault, config, node, path, problems)
    return options


def validated(
    config: type[ConfigT], node: MapNode
) -> tuple[ConfigT | None, Sequence[ErrorDetails]]:
    """Return the options in `node` and no errors, or None and pydantic's errors."""
    try:
        # JSON is pydantic's only strict mode for text: a list may be read as a tuple and a string
        # as a path, but no string as a number.
        return config.model_validate_json(json.dumps(node)), ()
    except ValidationError as error:
        return None, error.errors()


def report(
    fault: ErrorDetails, config: type[BaseModel], node: MapNode, path: KeyPath, problems: Problems
) -> None:
    """Add a problem for pydantic's error `fault` in the options `node`, which are at `path`."""
    steps, origin, given = find(node, fault["loc"])
    options = dict(options_in(config))
    # Layers have numbers, and one option of each name for all of them.
    shown = ".".join(step for step in map(str, steps) if not step.isdigit())
    if fault["type"] == "extra_forbidden":
        section, _, option = shown.rpartition(".")
        reason = f"there is no option `{option}` here"
        # A key of another section is not a typing error, so name that section.
        homes = {known.rpartition(".")[2]: known for known in reversed(options)}
        near = nearest(option, homes)
        split = [known.rpartition(".") for known in options]
        beside = [name for above, _, name in split if above == section]
        fix = f"did you mean `{homes[near]}`?" if near else did_you_mean("", beside, "options")
    else:
        reason, fix = _explain(fault, given)
    if fault["type"] == "missing":
        steps.append(fault["loc"][-1])
    field = options.get(shown)
    if field and not isinstance(field.default, BaseModel | PydanticUndefinedType):
        fix += f" (default: {inline(to_jsonable_python(field.get_default()))})"
    problems.add(origin, [*path, *map(str, steps)], reason, fix)


def options_in(annotation: Any, above: str = "") -> Iterator[tuple[str, FieldInfo]]:
    """Yield dotted path and declaration of every option in the type `annotation`, at any depth."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        for name, field in annotation.model_fields.items():
            yield above + name, field
            yield from options_in(field.annotation, f"{above}{name}.")
    for part in get_args(annotation):
        yield from options_in(part, above)


def _explain(error: ErrorDetails, given: Any) -> tuple[str, str]:
    """Return reason and fix for an error of pydantic. given: the invalid value in the recipe."""
    kind = error["type"]
    context = error.get("ctx", {})
    cause = context.get("error")
    written = str(given)
    if kind == "missing":
        return f"`{error['loc'][-1]}` is missing and has no default", "add it"
    if isinstance(cause, OptionError):
        return cause.reason, cause.fix
    if kind == "value_error":
        return str(cause), "change the value to meet this condition"
    reason = re.sub(r"^\w+ should ", "must ", error["msg"].split(", got")[0])
    reason = reason.replace(" after validation", "").replace("an object", "a mapping")
    if kind not in ("too_long", "too_short"):
        reason += f", got {brief(given)}"
    if kind == "literal_error":
        return reason, did_you_mean(written, re.findall(r"'([^']*)'", context["expected"]), "words")
    if kind == "bool_type":
        return reason, "write `true` or `false`: in YAML 1.2 other words are strings"
    if kind in ("model_type", "dict_type"):
        return reason, "write `key: value` lines below it"
    return reason, "put it in quotes" if kind == "string_type" else "write a valid value"
