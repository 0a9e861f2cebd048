"""The recipe reference of the guide, written from the Configs of what is installed.

`python tools/guide_reference.py` prints it; building the guide puts it on the site.
"""

import inspect
import re
from collections.abc import Iterator, Mapping
from typing import Any

from qgs.contracts import Component, ComponentConfig, EvaluationConfig, TrainingConfig, ViewsConfig
from qgs.recipe import slots
from qgs.recipe.registry import Registry, load_registry
from qgs.recipe.sections import DecoderSettings, ModelSettings, RecipeSettings
from qgs.recipe.slots import SLOTS
from qgs.recipe.yaml_text import dump

PLUGINS = ("locus", "ellipsoid", "landmark", "c3g", "gslrm", "globalsplat", "mvsplat")
PLUGINS += ("tokengs2026", "dinov2", "lpips", "rooms", "worlds", "datasets")

SECTIONS: Mapping[str, type[ComponentConfig]] = {
    "Top level": RecipeSettings,
    "model": ModelSettings,
    "model.decoder": DecoderSettings,
    "views": ViewsConfig,
    "training": TrainingConfig,
    "evaluation": EvaluationConfig,
}
"""Settings that are no components, by their place in a recipe."""


def reference() -> str:
    """Tables of all sections and of all components by slot, Markdown."""
    registry = load_registry(PLUGINS)
    parts = [
        f"## {name if name == 'Top level' else f'`{name}`'}\n\n{option_table(config)}\n"
        for name, config in SECTIONS.items()
    ]
    parts += [_slot_section(slot, registry) for slot in SLOTS]
    return "\n".join(parts)


def option_table(config: type[ComponentConfig]) -> str:
    """A table of all options of `config`: values, default, meaning."""
    schema = config.model_json_schema()
    if not schema.get("properties"):
        return "No options."
    rows = ["| option | values | default | meaning |", "|---|---|---|---|"]
    for name, option in schema["properties"].items():
        values = values_of(_resolved(option, schema.get("$defs", {})))
        if config.__component__ and name in config.__component__.scheduled:
            values += ", or a [schedule](#schedules)"
        default = f"`{_yaml(option['default'])}`" if "default" in option else "must be given"
        meaning = " ".join((config.model_fields[name].description or "").split())
        cells = (cell.replace("|", "\\|") for cell in (f"`{name}`", values, default, meaning))
        rows.append(f"| {' | '.join(cells)} |")
    return "\n".join(rows)


def _yaml(value: Any) -> str:
    return dump(value, flow=True).removesuffix("\n").removesuffix("\n...")


def _resolved(schema: Any, definitions: Mapping[str, Any]) -> Any:
    """`schema` with what its references lead to in their place."""
    if isinstance(schema, list):
        return [_resolved(item, definitions) for item in schema]
    if not isinstance(schema, dict):
        return schema
    if "$ref" in schema:
        return _resolved(definitions[schema["$ref"].rsplit("/", 1)[1]], definitions)
    return {key: _resolved(item, definitions) for key, item in schema.items()}


def values_of(schema: Mapping[str, Any]) -> str:
    """The values that a JSON Schema allows, in words."""
    if "const" in schema:
        return f"`{schema['const']}`"
    if "enum" in schema:
        return ", ".join(f"`{value}`" for value in schema["enum"])
    for key in ("anyOf", "oneOf"):
        if key in schema:
            return " or ".join(values_of(option) for option in schema[key])
    match schema.get("type"):
        case "array" if "prefixItems" in schema:
            return f"[{', '.join(values_of(item) for item in schema['prefixItems'])}]"
        case "array":
            return f"list of: {values_of(schema['items'])}"
        case "object" if "properties" in schema:
            inner = [f"{name}: {values_of(s)}" for name, s in schema["properties"].items()]
            return f"{{{', '.join(inner)}}}"
        case "object":
            return f"name to {values_of(schema['additionalProperties'])}"
        case kind:
            words = {"number": "number", "integer": "integer", "string": "text", "null": "`null`"}
            return " ".join([words.get(str(kind), "true or false"), *_bounds(schema)])


def _bounds(schema: Mapping[str, Any]) -> Iterator[str]:
    signs = {"minimum": "≥", "exclusiveMinimum": ">", "maximum": "≤", "exclusiveMaximum": "<"}
    found = [f"{sign} {_bound(schema[key])}" for key, sign in signs.items() if key in schema]
    if found:
        yield ", ".join(found)


def _bound(value: float) -> str:
    power = round(value).bit_length() - 1
    return f"2^{power}" if power > 30 and value == 2.0**power else f"{value:g}"


def _slot_section(slot: str, registry: Registry) -> str:
    section = slots.SECTIONS.get(slot)
    if section is None:
        place = f"model.{slot}" if slot in slots.MODEL_SLOTS else f"model.decoder.{slot}"
    else:
        place = f"{slot}.NAME" if section.named else slot
    default = f"There is none unless `{slot}` is written."
    if SLOTS[slot].default:
        default = f"Default: `{SLOTS[slot].default}`."
    elif section and section.named:
        listed = ", ".join(f"`{name}: {{type: {kind}}}`" for name, kind in section.defaults.items())
        default = f"Names are free. Default: {listed}."
        if section.defaults_stay:
            default += " These stay beside what is written; `NAME: null` drops one."
    contract = inspect.cleandoc(SLOTS[slot].contract.__doc__ or "").split("\n\n")[0]
    parts = [f"## Slot `{place}`", contract, default]
    for name, component in registry.components(slot).items():
        parts.append(f"### `{name}` {{ #{slot}-{name.replace('/', '-')} }}")
        paragraphs = inspect.cleandoc(component.__doc__ or "").split("\n\n")
        parts += [text for text in paragraphs if not re.match(r"\w+: ", text)]  # no attributes
        parts += [option_table(component.Config), *_fields_of(component)]
    return "\n\n".join(parts) + "\n"


def _fields_of(component: type[Component]) -> Iterator[str]:
    if any(field.is_required() for field in component.Config.model_fields.values()):
        return
    config = component.Config()
    fields = {"reads": component.fields_read(config), "writes": component.fields_written(config)}
    for verb, found in fields.items():
        if found:
            listed = ", ".join(f"`{name}` ({spec})" for name, spec in found.items())
            yield f"By default it {verb} {listed}."


if __name__ == "__main__":
    print(reference())
