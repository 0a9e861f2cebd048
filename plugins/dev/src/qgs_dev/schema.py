"""JSON Schema of recipes, with which editors complete, check and explain options."""

from typing import Any

import yaml

from qgs.contracts import Component, ComponentConfig
from qgs.contracts.schedule import Schedule
from qgs.recipe.registry import Registry
from qgs.recipe.sections import Layout
from qgs.recipe.slots import SLOTS, summary_of
from qgs.tokengs.schedules import SCHEDULES

_NULL = {"type": "null"}
_WRITTEN = """
extends:
  description: Base recipe file or files that this one changes, relative to this file.
  anyOf: [{type: string}, {type: array, items: {type: string}}]
swap:
  description: Replacement components by pattern of places, such as
    `decoder.layers.*.feed_forward`; null removes an inherited swap.
  type: object
"""
"""Schemas of recipe keys that are neither settings nor components."""


def recipe_schema(registry: Registry) -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of recipes that use the plugins of `registry`.

    No key is required, because an overlay recipe may leave out any key. Where `type` is left out,
    options of all components of the slot are allowed.
    """
    schema = settings_schema(Layout)
    written = yaml.safe_load(_WRITTEN)
    written["swap"]["additionalProperties"] = {"anyOf": [*map(_ref, SLOTS), _NULL]}
    schema["properties"] |= written
    definitions: dict[str, dict[str, Any]] = {}
    for slot in SLOTS:
        types = [_type(name, kind) for name, kind in registry.components(slot).items()]
        definitions[slot] = {"anyOf": types}
    kinds = [settings_schema(kind) for kind in dict.fromkeys(SCHEDULES.values())]
    definitions["schedule"] = {"anyOf": kinds, "description": summary_of(Schedule)}
    dialect = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "qgs recipe"}
    return {**dialect, **schema, "$defs": definitions}


def _type(name: str, component: type[Component]) -> dict[str, Any]:
    """Return the schema of a component: its options, and `type` with the only value `name`."""
    description = summary_of(component)
    schema = settings_schema(component.Config)
    properties = {"type": {"const": name, "description": description}, **schema["properties"]}
    return schema | {"description": description, "properties": properties}


def settings_schema(config: type[ComponentConfig]) -> dict[str, Any]:
    """Return the schema of the options in `config`, without references to definitions."""
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
    """Replace all references in `schema` by the definitions that they name."""
    if isinstance(schema, list):
        return [_inlined(item, definitions) for item in schema]
    if not isinstance(schema, dict):
        return schema
    if isinstance(slot := schema.get("slot"), str):
        # Null drops an inherited component.
        about = {key: schema[key] for key in schema.keys() & {"description"}}
        return {"anyOf": [_ref(slot), _NULL], **about}
    if "$ref" in schema:
        # Editors show the description at the reference, if there is one.
        schema = definitions[schema["$ref"].rsplit("/", 1)[1]] | schema
    left_out = ("$ref", "discriminator")
    return {k: _inlined(item, definitions) for k, item in schema.items() if k not in left_out}


def _ref(slot: str) -> dict[str, Any]:
    return {"$ref": f"#/$defs/{slot}"}
