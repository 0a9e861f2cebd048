"""The recipe reference of the guide, written from the Configs of what is installed.

`python tools/guide_reference.py` prints it; building the guide puts it on the site.
"""

import inspect
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jinja2 import Template

from qgs.contracts import Component, ComponentConfig, EvaluationConfig, TrainingConfig, ViewsConfig
from qgs.recipe import slots
from qgs.recipe.registry import load_usable_plugins
from qgs.recipe.sections import DecoderSettings, ModelSettings, RecipeSettings
from qgs.recipe.yaml_text import dump

REGISTRY = load_usable_plugins()[0]
SECTIONS: Mapping[str, type[ComponentConfig]] = {
    "Top level": RecipeSettings,
    "model": ModelSettings,
    "model.decoder": DecoderSettings,
    "views": ViewsConfig,
    "training": TrainingConfig,
    "evaluation": EvaluationConfig,
}
"""Settings that are no components, by their place in a recipe."""
TYPES = {
    "number": "number",
    "integer": "integer",
    "string": "text",
    "null": "`null`",
    "boolean": "true or false",
}
BOUNDS = {"minimum": "≥", "exclusiveMinimum": ">", "maximum": "≤", "exclusiveMaximum": "<"}


def filled_template(name: str, **values: Any) -> str:
    """Return what a template beside this file gives."""
    text = Path(__file__).with_name(name).read_text("utf-8")
    return Template(text, trim_blocks=True).render(values)


def reference() -> str:
    """Return tables of all sections and of all components by slot, Markdown."""
    return filled_template(
        "guide_reference.md.jinja",
        sections=SECTIONS,
        slots=slots.SLOTS,
        own_sections=slots.SECTIONS,
        model_slots=slots.MODEL_SLOTS,
        registry=REGISTRY,
        option_table=option_table,
        fields_of=fields_of,
        paragraphs=lambda documented: inspect.cleandoc(documented.__doc__ or "").split("\n\n"),
        is_attribute=lambda text: re.match(r"\w+: ", text),
    )


def option_table(config: type[ComponentConfig]) -> str:
    """Return a table of all options of `config`: values, default, meaning."""
    schema = config.model_json_schema()
    if not schema.get("properties"):
        return "No options."
    rows = ["| option | values | default | meaning |", "|---|---|---|---|"]
    for name, option in schema["properties"].items():
        values = values_of(option, schema.get("$defs", {}))
        if config.__component__ and name in config.__component__.scheduled:
            values += ", or a [schedule](#schedules)"
        default = "must be given"
        if "default" in option:
            text = dump(option["default"], flow=True)
            default = f"`{text.splitlines()[0]}`"
        meaning = " ".join((config.model_fields[name].description or "").split())
        cells = (cell.replace("|", "\\|") for cell in (f"`{name}`", values, default, meaning))
        rows.append(f"| {' | '.join(cells)} |")
    return "\n".join(rows)


def values_of(schema: Mapping[str, Any], definitions: Mapping[str, Any]) -> str:
    """Return the values that a JSON Schema allows, in words."""

    def several(schemas: Any) -> list[str]:
        return [values_of(each, definitions) for each in schemas]

    match schema:
        case {"$ref": place}:
            return values_of(definitions[place.rpartition("/")[2]], definitions)
        case {"const": value}:
            return f"`{value}`"
        case {"enum": values}:
            return ", ".join(f"`{value}`" for value in values)
        case {"anyOf": options} | {"oneOf": options}:
            return " or ".join(several(options))
        case {"type": "array", "prefixItems": items}:
            return f"[{', '.join(several(items))}]"
        case {"type": "array", "items": item}:
            return f"list of: {values_of(item, definitions)}"
        case {"properties": options}:
            pairs = zip(options, several(options.values()), strict=True)
            return f"{{{', '.join(f'{name}: {values}' for name, values in pairs)}}}"
        case {"type": "object", "additionalProperties": value}:
            return f"name to {values_of(value, definitions)}"
    bounds = [f"{sign} {_bound(schema[key])}" for key, sign in BOUNDS.items() if key in schema]
    return f"{TYPES[schema.get('type', 'boolean')]} {', '.join(bounds)}".rstrip()


def _bound(value: float) -> str:
    power = round(value).bit_length() - 1
    return f"2^{power}" if power > 30 and value == 2.0**power else f"{value:g}"


def fields_of(component: type[Component]) -> Mapping[str, Mapping[str, Any]]:
    """Return the fields that a component reads and writes by default; none if it has no default."""
    if any(field.is_required() for field in component.Config.model_fields.values()):
        return {}
    config = component.Config()
    return {"reads": component.fields_read(config), "writes": component.fields_written(config)}


if __name__ == "__main__":
    print(reference())
