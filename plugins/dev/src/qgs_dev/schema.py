"""Options of recipes, as the JSON Schema that editors read, and as the tables of `qgs list`."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml
from rich.markup import escape
from rich.table import Table

from qgs.checkpoint.models import about, card_of, checkpoint_path
from qgs.contracts import LAYER_SLOTS, Component, ComponentConfig
from qgs.contracts.schedule import Schedule
from qgs.recipe.registry import Registry, default_config
from qgs.recipe.sections import SETTINGS, Layout
from qgs.recipe.slots import MODEL_SLOTS, SLOTS, summary_of
from qgs.recipe.yaml_text import inline
from qgs.tokengs.schedules import SCHEDULES
from qgs.wording import nearest

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
        types = [_typed(name, kind) for name, kind in registry.components(slot).items()]
        definitions[slot] = {"anyOf": types}
    kinds = [settings_schema(kind) for kind in dict.fromkeys(SCHEDULES.values())]
    definitions["schedule"] = {"anyOf": kinds, "description": summary_of(Schedule)}
    dialect = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "qgs recipe"}
    return {**dialect, **schema, "$defs": definitions}


def _typed(name: str, component: type[Component]) -> dict[str, Any]:
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


Schema = Mapping[str, Any]

_WORDS = {"string": "text", "boolean": "true or false", "object": "mapping"}
_BOUNDS = {"minimum": ">=", "exclusiveMinimum": ">", "maximum": "<=", "exclusiveMaximum": "<"}


def overview(registry: Registry) -> Iterator[Table]:
    """Yield one table per slot: names, meanings and plugins of the installed components."""
    for name, slot in SLOTS.items():
        default = f" (default {slot.default})" if slot.default else ""
        components = registry.components(name).items()
        meanings = {kind: summary_of(component) for kind, component in components}
        yield _origins(recipe_path(name) + default, "type", meanings, registry)
    if models := _models(registry):
        meanings = {name: about(file) for name, file in models.items()}
        yield _origins("trained models", "name", meanings, registry)


def _origins(title: str, column: str, meanings: Mapping[str, str], registry: Registry) -> Table:
    rows = [(name, meaning, _release(name, registry)) for name, meaning in meanings.items()]
    return _table(title, (column, "meaning", "origin"), *rows)


def _table(title: str, *rows: Sequence[str]) -> Table:
    """Return a table that wraps long cells.

    rows: texts of the cells; the first row has the headers.
    """
    table = Table(title=title or None, title_justify="left")
    for column in rows[0]:
        table.add_column(column, overflow="fold")
    for row in rows[1:]:
        table.add_row(*map(escape, row))
    return table


def details(name: str, registry: Registry) -> Iterator[Table | str]:
    """Yield texts and tables that explain `name`.

    name: a component such as qgs/latent, a slot such as queries, a section of settings such as
    training, or a trained model such as rooms/locus-64. `recipe` stands for the settings at the top
    level of a recipe. Raises ValueError for an unknown name.
    """
    settings = {".".join(path) or "recipe": config for path, config in SETTINGS.items()}
    models = _models(registry)
    # a slot may be written with its place in a recipe, such as model.decoder.feed_forward
    slot = name.removeprefix("model.").removeprefix("decoder.")
    components = [(s, kind) for s in SLOTS for kind in registry.components(s)]
    shown = [(s, kind) for s, kind in components if name == kind or slot == s]
    if name in settings:
        yield from _explained(name, settings[name], settings[name])
    elif name in models:
        file = checkpoint_path(name)
        yield f"[bold]{escape(name)}[/bold], {escape(_release(name, registry))}"
        yield escape(f"{file}: {file.stat().st_size / 1e6:.1f} MB\n\n{card_of(file)}")
    elif not shown:
        known = [*SLOTS, *settings, *models, *(kind for _, kind in components)]
        near = nearest(name, known)
        hint = f"did you mean `{near}`?" if near else "`qgs list` shows all names"
        raise ValueError(f"there is no slot, component or section `{name}`; {hint}")
    for place, kind in shown:
        component = registry.components(place)[kind]
        heading = f"{recipe_path(place)}: {kind}, {_release(kind, registry)}"
        yield from _explained(heading, component, component.Config)
        if config := default_config(component):
            yield from _fields("requires", component.fields_read(config))
            yield from _fields("provides", component.fields_written(config))
        yield ""


def _explained(
    heading: str, described: type, config: type[ComponentConfig]
) -> Iterator[Table | str]:
    """Yield `heading`, the summary of the class `described`, and a table of `config`'s options."""
    yield f"[bold]{escape(heading)}[/bold]"
    yield escape(summary_of(described))
    rows = [*option_rows(settings_schema(config)["properties"])]
    yield _table("", ("option", "type", "default", "meaning"), *rows) if rows else "  no options"


def _fields(word: str, specs: Mapping[str, object]) -> Iterator[str]:
    if specs:
        text = "; ".join(f"{name} ({spec})" for name, spec in specs.items())
        yield escape(f"  {word}: {text}")


def _models(registry: Registry) -> dict[str, Path]:
    """Return the files of all trained models in plugins, by PLUGIN/NAME."""
    found: dict[str, Path] = {}
    for plugin in registry.plugins.values():
        found |= plugin.models
    return found


def _release(kind: str, registry: Registry) -> str:
    return registry.plugins[kind.split("/")[0]].released_as


def recipe_path(slot: str) -> str:
    """Return the path in a recipe where components of `slot` are set, such as `model.head`."""
    if slot in MODEL_SLOTS:
        return f"model.{slot}"
    return f"model.decoder.{slot}" if slot in LAYER_SLOTS else slot


def option_rows(properties: Mapping[str, Schema], above: str = "") -> Iterator[tuple[str, ...]]:
    """Yield a table row for each option: name, type, default and meaning.

    properties: JSON schema of each option, by name. If an option is a mapping, its inner options
    follow, with names such as `option.inner`. above: prefix of all names.
    """
    for name, option in properties.items():
        default = inline(option["default"]) if "default" in option else "required"
        meaning = " ".join(option.get("description", "").split())
        yield above + name, _type(option), default, meaning
        for variant in option.get("oneOf", [option]):
            yield from option_rows(variant.get("properties", {}), f"{above}{name}.")


def _type(option: Schema) -> str:
    """Describe the values that the JSON Schema of an option allows, such as "int >= 1"."""
    match option:
        case {"$ref": name}:
            return name.rpartition("/")[2]
        case {"anyOf": variants} | {"oneOf": variants}:
            return " or ".join(dict.fromkeys(map(_type, variants)))
        case {"enum": values}:
            return " or ".join(map(inline, values))
        case {"const": value}:
            return inline(value)
        case {"prefixItems": items}:
            return f"[{', '.join(map(_type, items))}]"
        case {"items": item}:
            return f"[{_type(item)}, ...]"
        case {"additionalProperties": dict(inner)}:
            return f"mapping to {_type(inner)}"
        case {"properties": {"kind": kind}}:
            return f"mapping of kind {_type(kind)}"
    bounds = [f"{sign} {option[key]}" for key, sign in _BOUNDS.items() if key in option]
    kind = option.get("type", "any")
    return f"{_WORDS.get(kind, kind)} {', '.join(bounds)}".strip()
