"""The recipe reference of the guide, written from the Configs of what is installed.

`python tools/guide_reference.py` prints it; building the guide puts it on the site.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator, Mapping
from typing import Any

from guide_docstrings import entries, joined

from qgs.composer.registry import Registry, load_registry
from qgs.composer.sections import DecoderSettings, ModelSettings, RecipeSettings
from qgs.composer.slots import DEFAULT_LOSSES, SLOTS, slot_at
from qgs.composer.yaml_text import dump
from qgs.contracts import Component, ComponentConfig, EvaluationConfig, TrainingConfig, ViewsConfig

PLUGINS = ("locus", "ellipsoid")

SECTIONS: tuple[tuple[str, type[ComponentConfig], str], ...] = (
    ("Top level", RecipeSettings, ""),
    ("model", ModelSettings, "Sizes that all components share, and the slots below."),
    ("model.decoder", DecoderSettings, "The decoder's template, and its slots below."),
    ("views", ViewsConfig, ""),
    ("training", TrainingConfig, ""),
    ("evaluation", EvaluationConfig, ""),
)

PLACES = {
    "encoder": ("model", "encoder"),
    "queries": ("model", "queries"),
    "cross_attention": ("model", "decoder", "cross_attention"),
    "self_attention": ("model", "decoder", "self_attention"),
    "feed_forward": ("model", "decoder", "feed_forward"),
    "refinement": ("model", "decoder", "refinement"),
    "head": ("model", "head"),
    "centers": ("model", "centers"),
    "supervision": ("model", "supervision"),
    "renderer": ("model", "renderer"),
    "losses": ("losses", "NAME"),
    "data": ("data",),
}
"""Slot to the place of a recipe that holds it."""

INTRODUCTION = """# Recipe reference

Every key that a recipe may have, written from the options of `qgs`, `qgs-locus` and `qgs-ellipsoid`
when this site was built. Defaults are in YAML's notation. An option that nothing reads, because of
another one, is refused unless it has its default.

Besides what stands below, a recipe has `extends` (one recipe or a list, relative to the file),
`plugins` (a list of names), `swap` (pattern of places to component) and `decoder.layers` (0-based
index to components of that layer alone). [The five ideas](ideas.md) explains them.
"""


def reference() -> str:
    """The whole page, Markdown."""
    registry = load_registry(PLUGINS)
    parts = [INTRODUCTION]
    for title, config, text in SECTIONS:
        heading = title if title == "Top level" else f"`{title}`"
        parts.append(f"## {heading}\n\n{text}\n\n{option_table(config)}\n")
    for slot in SLOTS:
        parts.append(_slot_section(slot, registry))
    return re.sub(r"\n{3,}", "\n\n", "\n".join(parts))


def option_table(config: type[ComponentConfig]) -> str:
    """A table of all options of `config`: values, default, meaning."""
    schema = config.model_json_schema()
    if not schema.get("properties"):
        return "No options."
    meanings = {name: in_yaml(text, config) for name, text in option_meanings(config).items()}
    rows = ["| option | values | default | meaning |", "|---|---|---|---|"]
    for name, option in schema["properties"].items():
        option_schema = _resolved(option, schema.get("$defs", {}))
        default = f"`{_yaml(option['default'])}`" if "default" in option else "must be given"
        rows.append(
            f"| `{name}` | {_escaped(values_of(option_schema))} | {_escaped(default)} "
            f"| {_escaped(meanings.get(name, ''))} |"
        )
    return "\n".join(rows)


def option_meanings(config: type[ComponentConfig]) -> dict[str, str]:
    """What the docstrings of `config` and its bases say of each option."""
    found: dict[str, str] = {}
    for base in config.__mro__:
        text = joined(inspect.cleandoc(base.__doc__ or "").replace("\n\n", "\n"))
        own: dict[str, str] = {}
        names: list[str] = []
        for line in text.splitlines():
            for listed, meaning in entries(line, config.model_fields):
                names = listed.split(", ") if listed else names
                own |= {name: f"{own.get(name, '')} {meaning}".strip() for name in names}
        found = own | found
    return found


def in_yaml(text: str, config: type[ComponentConfig]) -> str:
    """`text` of a docstring with Python's words for values of `config` as a recipe has them."""
    for python, yaml in {"None": "null", "True": "true", "False": "false"}.items():
        text = re.sub(rf"(?<![\w`]){python}(?![\w`])", f"`{yaml}`", text)
    for word in _choices(config.model_json_schema()):
        text = text.replace(f'"{word}"', f"`{word}`")
    return text


def _choices(schema: Any) -> set[str]:
    """Every word that `schema` lets an option choose."""
    if isinstance(schema, list):
        return {word for item in schema for word in _choices(item)}
    if not isinstance(schema, dict):
        return set()
    own = {value for value in schema.get("enum", ()) if isinstance(value, str)}
    return own | {word for item in schema.values() for word in _choices(item)}


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


def _slot_section(slot: str, registry: Registry) -> str:
    place = PLACES[slot]
    assert slot_at(place) is SLOTS[slot]
    default = f"Default: `{SLOTS[slot].default}`."
    if slot == "losses":
        listed = ", ".join(f"`{name}: {{type: {kind}}}`" for name, kind in DEFAULT_LOSSES.items())
        default = f"Names are free. Default: {listed}."
    elif slot == "data":
        kind = SLOTS[slot].default
        default = f"A recipe without `data` has none; `data` without a `type` is `{kind}`."
    parts = [
        f"## Slot `{'.'.join(place)}`",
        "",
        inspect.cleandoc(_contract_line(slot)),
        "",
        default,
    ]
    for name, component in registry.components(slot).items():
        summary = in_yaml(_summary(component), component.Config)
        parts += ["", f"### `{name}` {{ #{slot}-{name.replace('/', '-')} }}", "", summary, ""]
        parts += [option_table(component.Config), "", *_fields_of(component)]
    return "\n".join(parts) + "\n"


def _summary(component: type[Component]) -> str:
    """The docstring, but for paragraphs on attributes, which are no options."""
    paragraphs = inspect.cleandoc(component.__doc__ or "").split("\n\n")
    return "\n\n".join(text for text in paragraphs if not re.match(r"\w+: ", text))


def _contract_line(slot: str) -> str:
    return (SLOTS[slot].contract.__doc__ or "").split("\n\n")[0]


def _fields_of(component: type[Component]) -> Iterator[str]:
    if any(field.is_required() for field in component.Config.model_fields.values()):
        return
    config = component.Config()
    for verb, fields in (
        ("requires", component.requires(config)),
        ("provides", component.provides(config)),
    ):
        if fields:
            listed = ", ".join(f"`{name}` ({spec})" for name, spec in fields.items())
            yield f"By default it {verb} {listed}.\n"


def _resolved(schema: Any, definitions: Mapping[str, Any]) -> Any:
    if isinstance(schema, list):
        return [_resolved(item, definitions) for item in schema]
    if not isinstance(schema, dict):
        return schema
    if "$ref" in schema:
        return _resolved(definitions[schema["$ref"].rsplit("/", 1)[1]], definitions)
    return {key: _resolved(item, definitions) for key, item in schema.items()}


def _bounds(schema: Mapping[str, Any]) -> Iterator[str]:
    signs = {"minimum": "≥", "exclusiveMinimum": ">", "maximum": "≤", "exclusiveMaximum": "<"}
    found = [f"{sign} {_bound(schema[key])}" for key, sign in signs.items() if key in schema]
    if found:
        yield ", ".join(found)


def _bound(value: float) -> str:
    power = round(value).bit_length() - 1
    return f"2^{power}" if power > 30 and value == 2.0**power else f"{value:g}"


def _yaml(value: Any) -> str:
    return dump(value, flow=True).removesuffix("\n").removesuffix("\n...")


def _escaped(cell: str) -> str:
    return cell.replace("|", "\\|")


if __name__ == "__main__":
    print(reference())
