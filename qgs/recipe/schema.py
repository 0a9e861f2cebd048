"""The JSON Schema of a recipe, so that editors complete it, check it and show what options mean."""

import inspect
from typing import Any

import yaml

from qgs.contracts import LAYER_SLOTS, Component, ComponentConfig
from qgs.contracts.schedule import Schedule
from qgs.recipe.registry import Registry
from qgs.recipe.sections import SETTINGS
from qgs.recipe.slots import MODEL_SLOTS, SECTIONS, SLOTS
from qgs.recipe.yaml_text import KeyPath
from qgs.tokengs.schedules import SCHEDULES

_NULL = {"type": "null"}
_WRITTEN = """
extends:
  description: Recipe file or files that this one is laid over, relative to it.
  anyOf: [{type: string}, {type: array, items: {type: string}}]
swap:
  description: Components by pattern of the places that they take, such as
    `decoder.layers.*.feed_forward`; null drops an inherited swap.
  type: object
layers:
  description: Overrides of single layers, by their index from 0.
  type: object
  patternProperties: {"^[0-9]+$": {type: object}}
  additionalProperties: false
"""
"""Schemas of keys that are neither settings nor components."""


def recipe_schema(registry: Registry) -> dict[str, Any]:
    """JSON Schema (draft 2020-12) of recipes that use the plugins of `registry`.

    Nothing is required, as in overlays; without a `type` the options of all its slot may stand.
    """
    beside: dict[str, Any] = yaml.safe_load(_WRITTEN)
    layer = {name: _component(name) for name in LAYER_SLOTS}
    layers = beside.pop("layers")
    for overrides in layers["patternProperties"].values():
        overrides |= {"properties": layer, "additionalProperties": False}
    decoder = _section(("model", "decoder"), layer | {"layers": layers})
    parts = {name: _component(name) for name in MODEL_SLOTS}
    beside["swap"]["additionalProperties"] = {"anyOf": [*map(_ref, SLOTS), _NULL]}
    beside["model"] = _section(("model",), parts | {"decoder": decoder})
    for name, section in SECTIONS.items():
        described = _component(name)
        component = {"anyOf": described["anyOf"]}
        if section.named:
            component = {"type": "object", "additionalProperties": component}
        by_name = "By name: " if section.named else ""
        beside[name] = {"description": by_name + described["description"], **component}
    beside |= {path[0]: _section(path) for path in SETTINGS if path and path[0] not in beside}
    definitions: dict[str, dict[str, Any]] = {
        slot: {"anyOf": [_type(name, c) for name, c in registry.components(slot).items()]}
        for slot in SLOTS
    }
    kinds = [settings_schema(kind) for kind in dict.fromkeys(SCHEDULES.values())]
    definitions["schedule"] = {"anyOf": kinds, "description": summary_of(Schedule)}
    dialect = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "qgs recipe"}
    return {**dialect, **_section((), beside), "$defs": definitions}


def _type(name: str, component: type[Component]) -> dict[str, Any]:
    """The options of `component`, and the `type` that chooses it."""
    description = summary_of(component)
    schema = settings_schema(component.Config)
    properties = {"type": {"const": name, "description": description}, **schema["properties"]}
    return schema | {"description": description, "properties": properties}


def _section(path: KeyPath, beside: dict[str, Any] | None = None) -> dict[str, Any]:
    """The settings of a section. beside: what else stands in it."""
    schema = settings_schema(SETTINGS[path])
    return schema | {"properties": schema["properties"] | (beside or {})}


def settings_schema(config: type[ComponentConfig]) -> dict[str, Any]:
    """Options of a section or a component, without references."""
    schema = {"properties": {}} | config.model_json_schema()
    definitions = schema.pop("$defs", {})
    # An overlay sets an option and leaves the rest to its base.
    for key in ("required", "title"):
        schema.pop(key, None)
    schema = _inlined(schema, definitions)
    options = schema["properties"]
    for option in config.__component__.scheduled if config.__component__ else ():
        number = dict(options[option])
        # What editors show of an option stands beside its alternatives, not inside of one.
        apart = [key for key in ("description", "title", "default") if key in number]
        shown = {key: number.pop(key) for key in apart}
        options[option] = {**shown, "anyOf": [number, {"$ref": "#/$defs/schedule"}]}
    return schema


def _inlined(schema: Any, definitions: dict[str, Any]) -> Any:
    """`schema` with references to `definitions` replaced by what they stand for."""
    if isinstance(schema, list):
        return [_inlined(item, definitions) for item in schema]
    if not isinstance(schema, dict):
        return schema
    if "$ref" in schema:
        # Editors show the description at the reference, if there is one.
        schema = definitions[schema["$ref"].rsplit("/", 1)[1]] | schema
    left_out = ("$ref", "discriminator")
    return {k: _inlined(item, definitions) for k, item in schema.items() if k not in left_out}


def _component(slot: str) -> dict[str, Any]:
    """A component, or null, which drops an inherited one."""
    return {"anyOf": [_ref(slot), _NULL], "description": summary_of(SLOTS[slot].contract)}


def _ref(slot: str) -> dict[str, Any]:
    return {"$ref": f"#/$defs/{slot}"}


def summary_of(described: object) -> str:
    """The first paragraph of a docstring, on one line."""
    return " ".join((inspect.getdoc(described) or "").split("\n\n")[0].split())
