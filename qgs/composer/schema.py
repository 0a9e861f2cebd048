"""The JSON Schema of a recipe, so that editors complete and check it."""

from __future__ import annotations

from typing import Any

from qgs.composer.registry import Registry
from qgs.composer.sections import DecoderSettings, ModelSettings, RecipeSettings
from qgs.composer.slots import LAYER_SLOTS, MODEL_SLOTS, SECTIONS, SLOTS, Slot
from qgs.contracts import Component, ComponentConfig, EvaluationConfig, TrainingConfig, ViewsConfig

_NAMES = {"type": "array", "items": {"type": "string"}}


def recipe_schema(registry: Registry) -> dict[str, Any]:
    """JSON Schema (draft 2020-12) of recipes that use the plugins of `registry`.

    Nothing is required: an overlay may leave everything to what it extends. A component without a
    `type` may have the options of any component of its slot.
    """
    definitions = {slot.name: _slot(slot, registry) for slot in SLOTS.values()}
    layer = _object({name: _ref(name) for name in LAYER_SLOTS})
    decoder = _settings(DecoderSettings)
    decoder["properties"] |= {name: _ref(name) for name in LAYER_SLOTS}
    decoder["properties"]["layers"] = {
        "type": "object",
        "patternProperties": {"^[0-9]+$": layer},
        "additionalProperties": False,
    }
    model = _settings(ModelSettings)
    model["properties"] |= {name: _ref(name) for name in MODEL_SLOTS} | {"decoder": decoder}
    recipe = _settings(RecipeSettings)
    recipe["properties"] |= {
        "extends": {"anyOf": [{"type": "string"}, _NAMES]},
        "plugins": _NAMES,
        "swap": _mapping_of({"anyOf": [*map(_ref, SLOTS), {"type": "null"}]}),
        "model": model,
        **{name: _section(name) for name in SECTIONS},
        "views": _settings(ViewsConfig),
        "training": _settings(TrainingConfig),
        "evaluation": _settings(EvaluationConfig),
    }
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "qgs recipe",
        **recipe,
        "$defs": definitions,
    }


def _section(name: str) -> dict[str, Any]:
    component = {"anyOf": [_ref(name), {"type": "null"}]}
    return _mapping_of(component) if SECTIONS[name].named else component


def _slot(slot: Slot, registry: Registry) -> dict[str, Any]:
    components = registry.components(slot.name)
    return {"anyOf": [_component(name, component) for name, component in components.items()]}


def _component(name: str, component: type[Component]) -> dict[str, Any]:
    schema = _settings(component.Config)
    schema["properties"] = {"type": {"const": name}, **schema["properties"]}
    if component.__doc__:
        schema["description"] = component.__doc__.splitlines()[0]
    return schema


def _settings(config: type[ComponentConfig]) -> dict[str, Any]:
    schema = config.model_json_schema()
    definitions = schema.pop("$defs", {})
    schema.pop("required", None)
    schema.pop("title", None)
    schema.setdefault("properties", {})
    return _inlined(schema, definitions)


def _inlined(schema: Any, definitions: dict[str, Any]) -> Any:
    """`schema` with references to `definitions` replaced by what they stand for."""
    if isinstance(schema, list):
        return [_inlined(item, definitions) for item in schema]
    if not isinstance(schema, dict):
        return schema
    if "$ref" in schema:
        schema = definitions[schema["$ref"].rsplit("/", 1)[1]]
    return {
        key: _inlined(item, definitions) for key, item in schema.items() if key != "discriminator"
    }


def _ref(name: str) -> dict[str, Any]:
    return {"$ref": f"#/$defs/{name}"}


def _object(properties: dict[str, Any]) -> dict[str, Any]:
    return {"type": "object", "properties": properties, "additionalProperties": False}


def _mapping_of(item: dict[str, Any]) -> dict[str, Any]:
    return {"type": "object", "additionalProperties": item}
