"""The JSON Schema of a recipe, so that editors complete it, check it and show what options mean."""

from __future__ import annotations

import inspect
from typing import Any

from qgs.composer.nodes import KeyPath
from qgs.composer.registry import Registry
from qgs.composer.sections import SETTINGS
from qgs.composer.slots import LAYER_SLOTS, MODEL_SLOTS, SECTIONS, SLOTS
from qgs.contracts import Component, ComponentConfig


def recipe_schema(registry: Registry) -> dict[str, Any]:
    """JSON Schema (draft 2020-12) of recipes that use the plugins of `registry`.

    Nothing is required: an overlay may leave everything to what it extends. A component without a
    `type` may have the options of any component of its slot.
    """
    names = {"type": "array", "items": {"type": "string"}}
    layer = {name: _component(name) for name in LAYER_SLOTS}
    overrides = {
        "type": "object",
        "patternProperties": {"^[0-9]+$": _object(layer)},
        "additionalProperties": False,
    }
    layers = _described(overrides, "Overrides of single layers, by their index from 0.")
    decoder = _section(("model", "decoder"), layer | {"layers": layers})
    parts = {name: _component(name) for name in MODEL_SLOTS}
    any_component = {"anyOf": [*map(_ref, SLOTS), {"type": "null"}]}
    beside = {
        "extends": _described(
            {"anyOf": [{"type": "string"}, names]},
            "Recipe file or files that this one is laid over, relative to this file.",
        ),
        "plugins": _described(names, "Plugins whose components the recipe may name."),
        "swap": _described(
            _mapping_of(any_component),
            "Components by pattern of the places that they take, such as "
            "`decoder.layers.*.feed_forward`; null drops an inherited swap.",
        ),
        "model": _section(("model",), parts | {"decoder": decoder}),
    }
    for name, section in SECTIONS.items():
        component = _component(name, {"type": "null"})
        by_name = _described(_mapping_of(component), f"By name: {_summary(SLOTS[name].contract)}")
        beside[name] = by_name if section.named else component
    beside |= {path[0]: _section(path) for path in SETTINGS if path and path[0] not in beside}
    definitions = {
        name: {
            "anyOf": [
                _type(kind, component) for kind, component in registry.components(name).items()
            ]
        }
        for name in SLOTS
    }
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "qgs recipe",
        **_section((), beside),
        "$defs": definitions,
    }


def _type(name: str, component: type[Component]) -> dict[str, Any]:
    """The options of `component`, and the `type` that chooses it."""
    summary = _summary(component)
    schema = _described(_settings(component.Config), summary)
    kind = {"const": name, "description": summary}
    return schema | {"properties": {"type": kind, **schema["properties"]}}


def _section(path: KeyPath, beside: dict[str, Any] | None = None) -> dict[str, Any]:
    """The settings of a section. beside: what else stands in it."""
    schema = _settings(SETTINGS[path])
    return schema | {"properties": schema["properties"] | (beside or {})}


def _settings(config: type[ComponentConfig]) -> dict[str, Any]:
    schema = config.model_json_schema()
    definitions = schema.pop("$defs", {})
    schema.pop("required", None)
    schema.pop("title", None)
    return _inlined({"properties": {}} | schema, definitions)


def _inlined(schema: Any, definitions: dict[str, Any]) -> Any:
    """`schema` with references to `definitions` replaced by what they stand for."""
    if isinstance(schema, list):
        return [_inlined(item, definitions) for item in schema]
    if not isinstance(schema, dict):
        return schema
    if "$ref" in schema:
        schema = definitions[schema["$ref"].rsplit("/", 1)[1]] | schema
    left_out = ("$ref", "discriminator")
    return {k: _inlined(item, definitions) for k, item in schema.items() if k not in left_out}


def _component(slot: str, *others: dict[str, Any]) -> dict[str, Any]:
    schema = {"anyOf": [_ref(slot), *others]} if others else _ref(slot)
    return _described(schema, _summary(SLOTS[slot].contract))


def _summary(described: type) -> str:
    """The first paragraph of a docstring, on one line."""
    return " ".join((inspect.getdoc(described) or "").split("\n\n")[0].split())


def _described(schema: dict[str, Any], description: str) -> dict[str, Any]:
    return schema | {"description": description}


def _ref(name: str) -> dict[str, Any]:
    return {"$ref": f"#/$defs/{name}"}


def _object(properties: dict[str, Any]) -> dict[str, Any]:
    return {"type": "object", "properties": properties, "additionalProperties": False}


def _mapping_of(item: dict[str, Any]) -> dict[str, Any]:
    return {"type": "object", "additionalProperties": item}
