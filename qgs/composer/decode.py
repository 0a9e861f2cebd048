"""From what is written at a place to a component class and its Config."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeVar, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from qgs.composer.errors import Problems, did_you_mean, nearest
from qgs.composer.nodes import (
    KeyPath,
    ListNode,
    MapNode,
    Node,
    Origin,
    ScalarNode,
    is_null,
    kind_of,
    locate,
    to_plain,
)
from qgs.composer.places import Place
from qgs.composer.registry import InstalledPlugin, Registry, available_plugins, component_failure
from qgs.composer.slots import SLOTS, type_at
from qgs.contracts import Component, ComponentConfig, OptionError

_BOUNDS = {
    "greater_than": ("gt", "more than"),
    "greater_than_equal": ("ge", "at least"),
    "less_than": ("lt", "less than"),
    "less_than_equal": ("le", "at most"),
}
_LENGTHS = {"too_short": ("min_length", "at least"), "too_long": ("max_length", "at most")}
_KINDS = {
    "int_type": "an integer",
    "int_from_float": "an integer",
    "float_type": "a number",
    "bool_type": "true or false",
    "string_type": "a string",
    "tuple_type": "a list",
    "list_type": "a list",
    "dict_type": "a mapping",
    "model_type": "a mapping",
    "model_attributes_type": "a mapping",
}
_BOOL_WORDS = {
    **dict.fromkeys(("on", "yes", "y"), "true"),
    **dict.fromkeys(("off", "no", "n"), "false"),
}


def place_of(error: ErrorDetails, node: Node) -> tuple[str | int, ...]:
    """The steps from a component to the option that `error` is about, as written in `node`."""
    steps: list[str | int] = []
    for position, step in enumerate(error["loc"]):
        last = position == len(error["loc"]) - 1
        if isinstance(node, MapNode) and str(step) in node.items:
            node = node.items[str(step)]
        elif isinstance(node, ListNode) and isinstance(step, int) and step < len(node.items):
            node = node.items[step]
        elif not (last and error["type"] == "missing" and isinstance(step, str)):
            continue
        steps.append(step)
    return tuple(steps)


def explain(error: ErrorDetails, given: Node | None, config: type[BaseModel]) -> tuple[str, str]:
    """Reason and fix. given: the offending value; config: the class that refused it."""
    kind, context = error["type"], error.get("ctx", {})
    option = str(error["loc"][-1]) if error["loc"] else ""
    default = _default(config, error)
    what = kind_of(given) if given is not None else "nothing"
    if kind == "extra_forbidden":
        siblings = _options_beside(config, error["loc"])
        return f"there is no option `{option}`", did_you_mean(option, siblings, "options")
    if kind == "missing" and isinstance(given, ListNode):
        count = _items_expected(config, error["loc"])
        return f"needs {count} items, got {len(given.items)}", f"give {count} items{default}"
    if kind == "missing":
        return f"the option `{option}` is missing and has no default", f"add `{option}: ...`"
    if kind in _BOUNDS:
        name, words = _BOUNDS[kind]
        bound = f"{words} {context[name]:g}"
        return f"must be {bound}, got {what}", f"give a number of {bound}{default}"
    if kind in _LENGTHS:
        name, words = _LENGTHS[kind]
        length = f"{words} {context[name]} items"
        return f"must have {length}, got {context['actual_length']}", f"give {length}{default}"
    if kind in _KINDS:
        return f"must be {_KINDS[kind]}, got {what}", _kind_fix(kind, given, default)
    if kind == "literal_error":
        expected = context["expected"]
        return f"must be {expected}, got {what}", _literal_fix(given, expected, default)
    if kind == "finite_number":
        return f"must be a finite number, got {what}", f"give a finite number{default}"
    if kind == "value_error" and isinstance(context["error"], OptionError):
        return context["error"].reason, f"{context['error'].fix}{default}"
    if kind == "value_error":
        return str(context["error"]), f"change the value so that this holds{default}"
    message = error["msg"][:1].lower() + error["msg"][1:]
    return f"{message}, got {what}", f"give a value that fits{default}"


def _kind_fix(kind: str, given: Node | None, default: str) -> str:
    value = getattr(given, "value", None)
    if kind == "bool_type" and isinstance(value, str) and value.lower() in _BOOL_WORDS:
        word = _BOOL_WORDS[value.lower()]
        return f"write `{word}`: in YAML 1.2 `{value}` is a string"
    if kind == "string_type":
        return f"put it in quotes{default}"
    return f"give {_KINDS[kind]}{default}"


def _literal_fix(given: Node | None, expected: str, default: str) -> str:
    near = nearest(str(getattr(given, "value", "")), [word.strip("'") for word in _words(expected)])
    return f"did you mean `{near}`?" if near else f"choose {expected}{default}"


def _words(expected: str) -> list[str]:
    return expected.replace(" or ", ", ").split(", ")


def _default(config: type[BaseModel], error: ErrorDetails) -> str:
    """A note on the default of the top-level option that `error` is in."""
    field = config.model_fields.get(str(error["loc"][0])) if error["loc"] else None
    if field is None or field.is_required() or isinstance(field.default, BaseModel):
        return ""
    value = field.get_default()
    shown = list(value) if isinstance(value, tuple) else value
    return f" (default: {_yaml_word(shown)})"


def _yaml_word(value: object) -> str:
    words = {"True": "true", "False": "false", "None": "null"}
    return words.get(str(value), str(value))


def _options_beside(config: type[BaseModel], loc: tuple[str | int, ...]) -> set[str]:
    """Options of the (nested) config that the last step of `loc` was looked for in."""
    return {name for model in _models_at(config, loc[:-1]) for name in model.model_fields}


def _models_at(config: type[BaseModel], loc: tuple[str | int, ...]) -> set[type[BaseModel]]:
    """The (nested) configs that `loc` leads to; the tag of a union chooses among its members."""
    models = {config}
    for step in loc:
        fields = [m.model_fields[str(step)] for m in models if str(step) in m.model_fields]
        if fields:
            models = {model for field in fields for model in models_in(field.annotation)}
        else:
            models = {model for model in models if _is_tagged(model, step)} or models
    return models


def _is_tagged(model: type[BaseModel], tag: str | int) -> bool:
    return any(tag in get_args(field.annotation) for field in model.model_fields.values())


def _items_expected(config: type[BaseModel], loc: tuple[str | int, ...]) -> int:
    """Length of the tuple that the last step of `loc` counts in."""
    name = str(next(step for step in reversed(loc) if isinstance(step, str)))
    depth = loc.index(name)
    models = _models_at(config, loc[:depth])
    annotations = [m.model_fields[name].annotation for m in models if name in m.model_fields]
    return max(len(get_args(annotation)) for annotation in annotations)


def models_in(annotation: Any) -> set[type[BaseModel]]:
    """The (nested) configs that an option of this type can hold."""
    if get_origin(annotation) is None:
        is_model = isinstance(annotation, type) and issubclass(annotation, BaseModel)
        return {annotation} if is_model else set()
    return {model for part in get_args(annotation) for model in models_in(part)}


ConfigT = TypeVar("ConfigT", bound=ComponentConfig)


@dataclass(frozen=True)
class Chosen:
    """The component that stands at a place: its `type`, class, options, and where it came from."""

    place: Place
    type: str
    component: type[Component]
    config: ComponentConfig
    installed: InstalledPlugin

    @property
    def written_at(self) -> str:
        """The dotted path under which a user finds it."""
        return ".".join(self.place.source)


def decode_places(
    places: Mapping[KeyPath, Place], registry: Registry, problems: Problems
) -> dict[KeyPath, Chosen | None]:
    """The component of every place, None where there is none to be had (with a problem)."""
    return {path: _decode_place(place, registry, problems) for path, place in places.items()}


def decode_config(
    config: type[ConfigT], node: Node, path: KeyPath, problems: Problems
) -> ConfigT | None:
    """`node` as a `config`, in pydantic's strict JSON mode; None, and problems, where it is not."""
    try:
        return config.model_validate_json(json.dumps(to_plain(node)))
    except ValidationError as error:
        for detail in error.errors():
            steps = place_of(detail, node)
            reason, fix = explain(detail, _value_at(node, steps), config)
            problems.add(locate(node, steps), ".".join([*path, *map(str, steps)]), reason, fix)
        return None


def _decode_place(place: Place, registry: Registry, problems: Problems) -> Chosen | None:
    node = MapNode(place.origin) if place.node is None or is_null(place.node) else place.node
    if not isinstance(node, MapNode):
        problems.add(
            place.origin,
            ".".join(place.source),
            f"a component is a mapping, this is {kind_of(node)}",
            "write `{type: PLUGIN/NAME, option: value}`",
        )
        return None
    origin = node.keys.get("type", place.origin)
    name = type_at(node, place.path)
    component = _find(name, place, registry, origin, problems)
    if component is None:
        return None
    installed = registry.plugins[name.partition("/")[0]]
    try:
        config = decode_config(component.Config, node.without("type"), place.source, problems)
    except Exception as error:
        failure = component_failure(name, "Config", error, installed)
        problems.add(origin, ".".join(place.source), failure.reason, failure.fix, error)
        return None
    return None if config is None else Chosen(place, name, component, config, installed)


def _find(
    name: object, place: Place, registry: Registry, origin: Origin, problems: Problems
) -> type[Component] | None:
    installed = registry.components(place.slot.name)
    if isinstance(name, str) and name in installed:
        return installed[name]
    if isinstance(name, str) and name.partition("/")[0] in registry.unusable:
        return None  # its plugin is a problem already
    reason, fix = _why_not(name, place, registry)
    problems.add(origin, ".".join([*place.source, "type"]), reason, fix)
    return None


def _why_not(name: object, place: Place, registry: Registry) -> tuple[str, str]:
    slot = place.slot.name
    installed = registry.components(slot)
    if name is None:
        reason = f"the slot `{slot}` has no default component"
        return reason, f"add `type:`, one of {', '.join(sorted(installed))}"
    if not isinstance(name, str):
        given = name if isinstance(name, MapNode | ListNode) else ScalarNode(Origin(""), name)
        reason = f"`type` names a component, got {kind_of(given)}"
        return reason, f"choose {', '.join(sorted(installed))}"
    plugin, slash, _ = name.partition("/")
    if not slash:
        return _no_plugin_named(name, installed)
    if plugin not in registry.plugins:
        return _not_loaded(name, plugin, registry)
    elsewhere = [other for other in SLOTS if name in registry.components(other)]
    if elsewhere:
        reason = f"`{name}` belongs in the slot `{elsewhere[0]}`, not in `{slot}`"
        return reason, f"choose {', '.join(sorted(installed))}"
    reason = f"there is no component `{name}` for the slot `{slot}`"
    return reason, did_you_mean(name, installed, "components")


def _no_plugin_named(name: str, installed: Mapping[str, object]) -> tuple[str, str]:
    if "." in name or ":" in name:
        reason = f"`{name}` is an import path; `type` only names installed components"
        fix = "offer the class in a plugin (entry points `qgs.plugins`), name it PLUGIN/NAME"
        return reason, fix
    reason = f"`{name}` names no plugin: components are called PLUGIN/NAME"
    same = [known for known in installed if known.split("/")[1] == name]
    return reason, f"did you mean `{same[0]}`?" if same else did_you_mean(
        name, installed, "components"
    )


def _not_loaded(name: str, plugin: str, registry: Registry) -> tuple[str, str]:
    reason = f"`{name}` is of the plugin `{plugin}`, which this recipe does not use"
    if plugin in available_plugins():
        listed = [known for known in registry.plugins if known != "qgs"] + [plugin]
        return reason, f"add `plugins: [{', '.join(listed)}]`"
    near = nearest(plugin, [*registry.plugins, *available_plugins()])
    if near:
        return reason, f"did you mean the plugin `{near}`?"
    return reason, f"install the distribution of `{plugin}` and add `plugins: [{plugin}]`"


def _value_at(node: Node, steps: tuple[str | int, ...]) -> Node | None:
    for step in steps:
        if isinstance(node, MapNode):
            if str(step) not in node.items:
                return None
            node = node.items[str(step)]
        elif not isinstance(node, ScalarNode):
            node = node.items[int(step)]
    return node
