"""From what is written to settings of sections, and to component classes and their Configs."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar, get_args, get_origin

from pydantic import BaseModel, Field, ValidationError
from pydantic_core import ErrorDetails, PydanticUndefinedType, to_jsonable_python

from qgs.contracts import (
    LAYER_SLOTS,
    Component,
    ComponentConfig,
    EvaluationConfig,
    OptionError,
    TrainingConfig,
    ViewsConfig,
)
from qgs.contracts.schedule import Schedule, at_step, number_kinds
from qgs.recipe.errors import Problems, did_you_mean, nearest
from qgs.recipe.places import Place
from qgs.recipe.registry import InstalledPlugin, Registry, available_plugins, component_failure
from qgs.recipe.slots import MODEL_SLOTS, SECTIONS, SLOTS, type_at
from qgs.recipe.yaml_text import KeyPath, ListNode, MapNode, find, inline, kind_of
from qgs.tokengs.schedules import SCHEDULES

ConfigT = TypeVar("ConfigT", bound=ComponentConfig)
_BOOLS = {"on": "true", "yes": "true", "y": "true", "off": "false", "no": "false", "n": "false"}


class ModelSettings(ComponentConfig):
    """The model: sizes that all of its components share."""

    width: int = Field(default=1024, ge=1, le=65_536)
    """Features of a token and of a query (D in the papers)."""
    heads: int = Field(default=16, ge=1)
    """Attention heads (h in the papers), a divisor of the width."""


class DecoderSettings(ComponentConfig):
    """The decoder, but for the components of its layers."""

    depth: int = Field(default=12, ge=0, le=256)
    """Number of layers (L in the papers); 0 decodes the queries as they start."""
    layer_scale: float = Field(default=5e-5, gt=0)
    """Initial LayerScale of every sublayer (TokenGS release)."""


class RecipeSettings(ComponentConfig):
    """Settings at the top of a recipe."""

    recipe: int = Field(ge=1, le=1)
    """Version of the recipe format."""
    seed: int = Field(default=0, ge=0, lt=2**63)
    """Of the model's initial parameters and of training."""
    init_from: str | None = None
    """Checkpoint whose weights training starts from, its queries made as many as this recipe has
    (LocusGS release: finetuning); null to start from the initial parameters."""


SETTINGS: dict[KeyPath, type[ComponentConfig]] = {
    (): RecipeSettings,
    ("model",): ModelSettings,
    ("model", "decoder"): DecoderSettings,
    ("views",): ViewsConfig,
    ("training",): TrainingConfig,
    ("evaluation",): EvaluationConfig,
}
_BESIDE: dict[KeyPath, tuple[str, ...]] = {
    (): ("plugins", "swap", "model", *SECTIONS, "views", "training", "evaluation"),
    ("model",): (*MODEL_SLOTS, "decoder"),
    ("model", "decoder"): (*LAYER_SLOTS, "layers"),
}
"""Keys that stand beside the settings of a section."""
_KEYS = {path: {*SETTINGS[path].model_fields, *keys} for path, keys in _BESIDE.items()}
_LAYERS: KeyPath = ("model", "decoder", "layers")
_MAPPINGS: set[KeyPath] = {
    *(("swap",), _LAYERS, *SETTINGS),
    *((name,) for name, section in SECTIONS.items() if section.named),
}


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

    @property
    def later(self) -> list[ComponentConfig]:
        """The options at the extremes of the schedules, but for the first."""
        return [at_step(self.config, self.schedules, step) for step in corners(self.schedules)[1:]]

    @property
    def path(self) -> str:
        """The dotted path under which a user finds it."""
        return ".".join(self.place.source)

    @property
    def chosen_at(self) -> str:
        """Where its `type` is written."""
        node = self.place.node
        origin = node.origins.get("type") if isinstance(node, MapNode) else None
        return str(origin) if origin else "default of the slot"


def decode_place(place: Place, registry: Registry, problems: Problems) -> Chosen | None:
    """The component of a place; None, with a problem, where there is none to be had."""
    path = ".".join(place.source)
    node = MapNode(place.origin) if place.node is None else place.node
    if not isinstance(node, MapNode):
        reason = f"a component is a mapping, this is {kind_of(node)}"
        problems.add(place.origin, path, reason, "write `{type: PLUGIN/NAME, option: value}`")
        return None
    name = type_at(node, place.path)
    origin = node.origins.get("type", place.origin)
    component = registry.components(place.slot.name).get(name) if isinstance(name, str) else None
    if component is None:
        plugin = name.partition("/")[0] if isinstance(name, str) else ""
        if plugin not in registry.unusable:  # else the plugin has been reported already
            problems.add(origin, f"{path}.type", *_why_no_component(name, place, registry))
        return None
    installed = registry.plugins[name.partition("/")[0]]
    try:
        found = _decode_options(component, name, node.without("type"), place.source, problems)
    except Exception as error:
        failure = component_failure(name, "Config", error, installed)
        problems.add(origin, path, failure.reason, failure.fix, error)
        return None
    if found is None:
        return None
    config, schedules = found
    return Chosen(place, name, component, config, installed, schedules)


def _decode_options(
    component: type[Component], name: str, node: MapNode, path: KeyPath, problems: Problems
) -> tuple[ComponentConfig, dict[str, Schedule]] | None:
    """The first options and the schedules of the rest, all of whose extremes are within limits."""
    schedules, fields, valid = dict[str, Schedule](), component.Config.model_fields, True
    for option, value, origin in node.entries():
        number = option in fields and number_kinds(fields[option].annotation)
        if not number or not isinstance(value, MapNode):
            continue
        below, schedule = (*path, option), None
        kind = str(value.get("schedule", ""))
        if option not in component.scheduled:
            reason = f"`{option}` of `{name}` takes no schedule: it is fixed in training"
            can = f"options that can: {', '.join(sorted(component.scheduled)) or 'none'}"
            problems.add(origin, ".".join(below), reason, f"give one number ({can})")
        elif kind in SCHEDULES:
            schedule = decode_config(SCHEDULES[kind], value, below, problems)
        else:
            reason = "a mapping in place of a number is a schedule, and names its kind"
            fix = did_you_mean(kind, SCHEDULES, "schedules")
            where = value.origins.get("schedule", origin)
            problems.add(where, ".".join((*below, "schedule")), reason, fix)
        valid &= schedule is not None
        schedules |= {option: schedule} if schedule else {}
    configs = list[ComponentConfig]()
    for step in corners(schedules) if valid else ():
        numbers = {n: s.number(step) for n, s in schedules.items()}
        # Options that are integers refuse 2.0, so that integral numbers are written as 2.
        written = {n: int(x) if x.is_integer() else x for n, x in numbers.items()}
        entries = ((n, written.get(n, value), at) for n, value, at in node.entries())
        config = decode_config(component.Config, MapNode(node.origin, entries), path, problems)
        if config is None:
            return None
        configs.append(config)
    return (configs[0], schedules) if configs else None


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
        available = available_plugins()
        if plugin not in available and (near := nearest(plugin, [*registry.plugins, *available])):
            return reason, f"did you mean the plugin `{near}`?"
        listed = ", ".join([used for used in registry.plugins if used != "qgs"] + [plugin])
        install = "" if plugin in available else f"install the distribution of `{plugin}` and "
        return reason, f"{install}add `plugins: [{listed}]`"
    if elsewhere := [other for other in SLOTS if name in registry.components(other)]:
        return f"`{name}` belongs in the slot `{elsewhere[0]}`, not in `{slot}`", choice
    reason = f"there is no component `{name}` for the slot `{slot}`"
    return reason, did_you_mean(name, known, "components")


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
        loc, kind = detail["loc"], detail["type"]
        steps, origin, given = find(node, loc)
        if kind == "missing" and isinstance(given, ListNode):
            same = [d["loc"][-1] for d in details if d["loc"][:-1] == loc[:-1]]
            count = 1 + max(index for index in same if isinstance(index, int))
            reason, fix = f"needs {count} items, got {len(given)}", f"give {count} items"
        else:
            steps += [loc[-1]] if kind == "missing" else []
            reason, fix = _explain(detail, given, config)
        name = ".".join([*path, *map(str, steps)])
        field = config.model_fields.get(str(loc[0])) if loc else None
        if field and not isinstance(field.default, BaseModel | PydanticUndefinedType):
            fix += f" (default: {inline(to_jsonable_python(field.get_default()))})"
        problems.add(origin, name, reason, fix)
    return None


def _explain(error: ErrorDetails, given: Any, config: type[BaseModel]) -> tuple[str, str]:
    """Reason and fix: pydantic's message, or a better one where we know more than pydantic."""
    kind, context = error["type"], error.get("ctx", {})
    cause = context.get("error")
    option = str(error["loc"][-1]) if error["loc"] else ""
    if kind == "extra_forbidden":
        siblings = _options_beside(config, error["loc"])
        return f"there is no option `{option}`", did_you_mean(option, siblings, "options")
    if kind == "missing":
        return f"the option `{option}` is missing and has no default", f"add `{option}: ...`"
    if isinstance(cause, OptionError):
        return cause.reason, cause.fix
    if kind == "value_error":
        return str(cause), "change the value so that this holds"
    message = re.sub(r"^\w+ should ", "must ", error["msg"].split(", got")[0])
    got = "" if kind in ("too_long", "too_short") else f", got {kind_of(given)}"
    reason, written = message.replace(" after validation", "") + got, str(given)
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
        models = set().union(*inner) or tagged or models
    return {name for model in models for name in model.model_fields}


def models_in(annotation: Any) -> set[type[BaseModel]]:
    """The (nested) configs that an option of this type can hold."""
    if get_origin(annotation) is None:
        is_model = isinstance(annotation, type) and issubclass(annotation, BaseModel)
        return {annotation} if is_model else set()
    return {model for part in get_args(annotation) for model in models_in(part)}


def check_tree(tree: MapNode, problems: Problems, path: KeyPath = ()) -> MapNode:
    """Report unknown keys and sections that are no mappings; the tree without them."""
    known = {*LAYER_SLOTS} if path[:-1] == _LAYERS else _KEYS.get(path)
    checked = []
    for key, node, origin in tree.entries():
        below = (*path, key)
        if known is not None and key not in known:
            homes = [".".join((*home, key)) for home, keys in _KEYS.items() if key in keys]
            fix = f"did you mean `{homes[0]}`?" if homes else did_you_mean(key, known, "keys")
            problems.add(origin, ".".join(below), f"there is no key `{key}` here", fix)
        elif below not in _MAPPINGS and path != _LAYERS:
            checked.append((key, node, origin))
        elif isinstance(node, MapNode):
            checked.append((key, check_tree(node, problems, below), origin))
        elif node is not None:
            reason = f"`{key}` is a mapping, this is {kind_of(node)}"
            fix = f"write `key: value` lines below `{key}:`"
            problems.add(origin, ".".join(below), reason, fix)
    return MapNode(tree.origin, checked)


def decode_settings(tree: MapNode, problems: Problems) -> tuple[dict[KeyPath, Any], bool]:
    """Settings by section, defaults for one with problems; whether the model's sizes are valid."""
    settings: dict[KeyPath, Any] = {}
    sizes_known = True
    for path, config in SETTINGS.items():
        node = tree.child(*path).without(*_BESIDE.get(path, ()))
        found = decode_config(config, node, path, problems)
        settings[path] = found or config.model_construct()
        sizes_known &= bool(found) or path[:1] != ("model",)
    model, node = settings["model",], tree.child("model")
    if model.width % model.heads:
        reason = f"{model.heads} heads do not divide the width {model.width}"
        fix = f"set model.heads to a divisor of {model.width}"
        origin = node.origins.get("heads", node.origins.get("width", node.origin))
        problems.add(origin, "model.heads", reason, fix)
    return settings, sizes_known
