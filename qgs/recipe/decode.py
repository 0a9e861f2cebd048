"""From what is written at a place to a component class and its Config."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, TypeAlias, TypeVar, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails, PydanticUndefinedType, to_jsonable_python

from qgs.contracts import Component, ComponentConfig, OptionError
from qgs.contracts.schedule import Schedule, at_step, number_kinds
from qgs.recipe.errors import Origin, Problems, did_you_mean, nearest
from qgs.recipe.places import Place
from qgs.recipe.registry import InstalledPlugin, Registry, available_plugins, component_failure
from qgs.recipe.slots import SLOTS, type_at
from qgs.recipe.yaml_text import KeyPath, ListNode, MapNode, find, inline, kind_of
from qgs.tokengs.schedules import SCHEDULES

ConfigT = TypeVar("ConfigT", bound=ComponentConfig)
# YAML 1.1, which most tools read, takes these words for truth values.
_BOOLS = {"on": "true", "yes": "true", "y": "true", "off": "false", "no": "false", "n": "false"}


@dataclass(frozen=True)
class Chosen:
    """The component that stands at a place: its `type`, class, options, and where it came from.

    schedules: of options that follow the progress of training; `config` has their first numbers.
    """

    place: Place
    type: str
    component: type[Component]
    config: ComponentConfig
    installed: InstalledPlugin
    schedules: Mapping[str, Schedule] = field(default_factory=dict)

    @property
    def options(self) -> dict[str, Any]:
        """The options as a recipe writes them."""
        written = {name: s.model_dump(mode="json") for name, s in self.schedules.items()}
        return self.config.model_dump(mode="json") | written

    def equals(self, other: Chosen | None) -> bool:
        """Return whether `other` is the same component with the same options."""
        if other is None or self.component is not other.component:
            return False
        return self.options == other.options

    @property
    def later(self) -> list[ComponentConfig]:
        """The options at the extremes of the schedules, but for the first."""
        return [at_step(self.config, self.schedules, step) for step in corners(self.schedules)[1:]]

    @property
    def path(self) -> str:
        """The dotted path under which a user finds it."""
        return ".".join(self.place.source)

    @property
    def node(self) -> MapNode:
        """The mapping written at its place; an empty one where there is none."""
        node = self.place.node
        return node if isinstance(node, MapNode) else MapNode(self.place.origin)

    @property
    def chosen_at(self) -> str:
        """File and line of its `type`."""
        return str(self.node.origins.get("type", "default of the slot"))


Parts: TypeAlias = Mapping[KeyPath, Chosen | None]
"""Components by place; None for one that could not be decoded."""


def decode_place(place: Place, registry: Registry, problems: Problems) -> Chosen | None:
    """The component of a place; None, with a problem, where there is none to be had."""
    node = MapNode(place.origin) if place.node is None else place.node
    if not isinstance(node, MapNode):
        reason = f"a component is a mapping, this is {kind_of(node)}"
        fix = "write `{type: PLUGIN/NAME, option: value}`"
        problems.add(place.origin, place.source, reason, fix)
        return None
    name = type_at(node, place.path)
    origin = node.origins.get("type", place.origin)
    plugin = name.partition("/")[0] if isinstance(name, str) else ""
    component = registry.components(place.slot.name).get(name) if plugin else None
    if component is None:
        # What comes from a plugin that cannot be used has been reported with the plugin.
        if plugin not in registry.unusable:
            reason, fix = _why_no_component(name, place, registry)
            problems.add(origin, (*place.source, "type"), reason, fix)
        return None
    installed = registry.plugins[plugin]
    try:
        found = _decode_options(component, name, node.without("type"), place.source, problems)
    except Exception as error:
        failure = component_failure(name, "Config", error, installed)
        problems.add(origin, place.source, failure.reason, failure.fix, error)
        return None
    if found is None:
        return None
    config, schedules = found
    return Chosen(place, name, component, config, installed, schedules)


def _decode_options(
    component: type[Component], name: str, node: MapNode, path: KeyPath, problems: Problems
) -> tuple[ComponentConfig, dict[str, Schedule]] | None:
    """The first options and the schedules of the rest, all of whose extremes are within limits."""
    fields = component.Config.model_fields
    schedules = dict[str, Schedule | None]()
    for option, value, origin in node.entries():
        number = option in fields and number_kinds(fields[option].annotation)
        if number and isinstance(value, MapNode) and option in component.scheduled:
            schedules[option] = _decode_schedule(value, origin, (*path, option), problems)
        elif number and isinstance(value, MapNode):
            reason = f"`{option}` of `{name}` takes no schedule: it is fixed in training"
            can = ", ".join(sorted(component.scheduled)) or "none"
            fix = f"give one number (options that can: {can})"
            problems.add(origin, (*path, option), reason, fix)
            schedules[option] = None
    valid = {option: schedule for option, schedule in schedules.items() if schedule}
    if len(valid) < len(schedules):
        return None
    configs = list[ComponentConfig]()
    # Between two corners a schedule is monotonic, so that no other step is beyond its limits.
    for step in corners(valid):
        options = MapNode(node.origin, node.entries())
        for option, schedule in valid.items():
            number = schedule.number(step)
            # Options that are integers refuse 2.0, so that integral numbers are written as 2.
            written = int(number) if number.is_integer() else number
            options.put(option, written, node.origins[option])
        config = decode_config(component.Config, options, path, problems)
        if config is None:
            return None
        configs.append(config)
    return configs[0], valid


def _decode_schedule(
    node: MapNode, origin: Origin, path: KeyPath, problems: Problems
) -> Schedule | None:
    kind = str(node.get("schedule", ""))
    if kind in SCHEDULES:
        return decode_config(SCHEDULES[kind], node, path, problems)
    reason = "a mapping in place of a number is a schedule, and names its kind"
    fix = did_you_mean(kind, SCHEDULES, "schedules")
    problems.add(node.origins.get("schedule", origin), (*path, "schedule"), reason, fix)
    return None


def corners(schedules: Mapping[str, Schedule]) -> list[int]:
    """The steps at which any of them may have an extreme, with the first."""
    return sorted({0, *(step for schedule in schedules.values() for step in schedule.corners)})


def _why_no_component(name: object, place: Place, registry: Registry) -> tuple[str, str]:
    """Reason and fix for a `type` that names no component of the place's slot."""
    slot = place.slot.name
    known = registry.components(slot)
    choice = f"choose {', '.join(sorted(known))}"
    if name is None:
        reason = f"no `type` is given, and the slot `{slot}` has no default component"
        return reason, f"add `type:`; {choice}"
    if not isinstance(name, str):
        return f"`type` names a component, got {kind_of(name)}", choice
    plugin, slash, _ = name.partition("/")
    if not slash and ("." in name or ":" in name):
        reason = f"`{name}` is an import path; `type` only names installed components"
        return reason, "offer the class in a plugin (entry points `qgs.plugins`)"
    if not slash:
        reason = f"`{name}` names no plugin: components are called PLUGIN/NAME"
        same = [kind for kind in known if kind.endswith(f"/{name}")]
        return reason, f"did you mean `{same[0]}`?" if same else choice
    if plugin not in registry.plugins:
        reason = f"`{name}` is of the plugin `{plugin}`, which this recipe does not use"
        return reason, _how_to_use(plugin, registry)
    # The same name may stand in several slots, such as `qgs/none`.
    for other in SLOTS:
        if name in registry.components(other):
            return f"`{name}` belongs in the slot `{other}`, not in `{slot}`", choice
    reason = f"there is no component `{name}` for the slot `{slot}`"
    return reason, did_you_mean(name, known, "components")


def _how_to_use(plugin: str, registry: Registry) -> str:
    """A fix for a recipe that does not list `plugin`."""
    available = available_plugins()
    if plugin in available:
        install = ""
    elif near := nearest(plugin, [*registry.plugins, *available]):
        return f"did you mean the plugin `{near}`?"
    else:
        install = f"install the distribution of `{plugin}` and "
    listed = [used for used in registry.plugins if used != "qgs"]
    return f"{install}add `plugins: [{', '.join([*listed, plugin])}]`"


def decode_config(
    config: type[ConfigT], node: MapNode, path: KeyPath, problems: Problems
) -> ConfigT | None:
    """The options written as `node` at `path`; None, with problems, if `config` refuses them."""
    try:
        # JSON is pydantic's only strict mode for text: a list may be read as a tuple and a string
        # as a path, but no string as a number.
        return config.model_validate_json(json.dumps(node))
    except ValidationError as error:
        details = error.errors()
    for detail in details:
        loc = detail["loc"]
        steps, origin, given = find(node, loc)
        if detail["type"] != "missing":
            reason, fix = _explain(detail, given, config)
        elif isinstance(given, ListNode):
            # pydantic reports each item that a tuple lacks
            same = [other["loc"][-1] for other in details if other["loc"][:-1] == loc[:-1]]
            count = 1 + max(index for index in same if isinstance(index, int))
            reason = f"needs {count} items, got {len(given)}"
            fix = f"give {count} items"
        else:
            steps.append(loc[-1])
            reason = f"the option `{loc[-1]}` is missing and has no default"
            fix = f"add `{loc[-1]}: ...`"
        field = config.model_fields.get(str(loc[0])) if loc else None
        if field and not isinstance(field.default, BaseModel | PydanticUndefinedType):
            fix += f" (default: {inline(to_jsonable_python(field.get_default()))})"
        problems.add(origin, [*path, *map(str, steps)], reason, fix)
    return None


def _explain(error: ErrorDetails, given: Any, config: type[BaseModel]) -> tuple[str, str]:
    """Reason and fix: pydantic's message, or a better one where we know more than pydantic."""
    kind = error["type"]
    context = error.get("ctx", {})
    cause = context.get("error")
    if kind == "extra_forbidden":
        option = str(error["loc"][-1])
        siblings = _options_beside(config, error["loc"])
        return f"there is no option `{option}`", did_you_mean(option, siblings, "options")
    if isinstance(cause, OptionError):
        return cause.reason, cause.fix
    if kind == "value_error":
        return str(cause), "change the value so that this holds"
    written = str(given)
    reason = re.sub(r"^\w+ should ", "must ", error["msg"].split(", got")[0])
    reason = reason.replace(" after validation", "")
    if kind not in ("too_long", "too_short"):
        reason += f", got {kind_of(given)}"
    if kind == "bool_type" and written.lower() in _BOOLS:
        word = _BOOLS[written.lower()]
        return reason, f"write `{word}`: in YAML 1.2 `{written}` is a string"
    if kind == "string_type":
        return reason, "put it in quotes"
    if kind == "literal_error":
        near = nearest(written, re.findall(r"'([^']*)'", context["expected"]))
        return reason, f"did you mean `{near}`?" if near else f"choose {context['expected']}"
    return reason, "give a value that fits"


def _options_beside(config: type[BaseModel], loc: tuple[str | int, ...]) -> set[str]:
    """Options of the (nested) config that lacks `loc[-1]`; a step may be the tag of a union."""
    models: set[type[BaseModel]] = {config}
    for step in loc[:-1]:
        fields = [(name, field, m) for m in models for name, field in m.model_fields.items()]
        inner = [models_in(field.annotation) for name, field, _ in fields if name == step]
        tagged = {m for _, field, m in fields if step in get_args(field.annotation)}
        # A step that is no field is an index of a list or a key of a mapping.
        models = set().union(*inner) or tagged or models
    return {name for model in models for name in model.model_fields}


def models_in(annotation: Any) -> set[type[BaseModel]]:
    """The (nested) configs that an option of this type can hold."""
    if get_origin(annotation) is None:
        is_model = isinstance(annotation, type) and issubclass(annotation, BaseModel)
        return {annotation} if is_model else set()
    return {model for part in get_args(annotation) for model in models_in(part)}
