"""What `qgs list` shows: installed components, and every option with its meaning."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from rich.console import Group
from rich.markup import escape
from rich.table import Table

from qgs.composer.decode import SETTINGS
from qgs.composer.errors import did_you_mean
from qgs.composer.registry import Registry, default_config
from qgs.composer.schema import recipe_schema
from qgs.composer.slots import LAYER_SLOTS, MODEL_SLOTS, SLOTS
from qgs.composer.yaml_text import inline
from qgs.contracts import Component
from qgs.io.models import about, card_of, checkpoint_path

Schema = Mapping[str, Any]

_WORDS = {"string": "text", "boolean": "true or false", "object": "mapping"}
_BOUNDS = {"minimum": ">=", "exclusiveMinimum": ">", "maximum": "<=", "exclusiveMaximum": "<"}


def overview(registry: Registry) -> Iterator[Table]:
    """One table per slot: installed components, what they are, where they come from."""
    definitions = recipe_schema(registry)["$defs"]
    for name, slot in SLOTS.items():
        default = f" (default {slot.default})" if slot.default else ""
        table = Table(title=recipe_path(name) + default, title_justify="left")
        for column in ("type", "meaning", "origin"):
            table.add_column(column, overflow="fold")
        for kind, schema in _by_type(definitions[name]).items():
            table.add_row(*map(escape, (kind, schema["description"], _release(kind, registry))))
        yield table
    table = Table("name", "meaning", "origin", title="trained models", title_justify="left")
    table.columns[1].overflow = "fold"
    for name, file in (models := _models(registry)).items():
        table.add_row(*map(escape, (name, about(file), _release(name, registry))))
    if models:
        yield table


def _models(registry: Registry) -> dict[str, Path]:
    """The file of every shipped model by PLUGIN/NAME."""
    return {k: file for known in registry.plugins.values() for k, file in known.models.items()}


def details(name: str, registry: Registry) -> Iterator[Group]:
    """The options of a component (`qgs/latent`), of all in a slot, or of a section of settings.

    Of a trained model its file and its card.

    `recipe` stands for the settings at the top of a recipe. Raises ValueError for other names.
    """
    schema = recipe_schema(registry)
    settings = {".".join(path) or "recipe": path for path in SETTINGS}
    if name in settings:
        for key in settings[name]:
            schema = schema["properties"][key]
        options = {key: schema["properties"][key] for key in SETTINGS[settings[name]].model_fields}
        about = schema.get("description", "")
        yield Group(f"[bold]{name}[/bold]", escape(about), _options(options))
        return
    if name in (models := _models(registry)):
        file = checkpoint_path(name)
        size = f"{file}: {file.stat().st_size / 1e6:.1f} MB"
        heading = f"[bold]{escape(name)}[/bold], {escape(_release(name, registry))}"
        yield Group(heading, escape(size), "", escape(card_of(file)))
        return
    slot = name.removeprefix("model.").removeprefix("decoder.")
    shown = [
        (place, kind, component)
        for place in SLOTS
        for kind, component in registry.components(place).items()
        if name == kind or slot == place
    ]
    if not shown:
        known = [*SLOTS, *settings, *models, *(k for p in SLOTS for k in registry.components(p))]
        raise ValueError(
            f"there is no slot, component or section `{name}`; {did_you_mean(name, known, 'names')}"
        )
    for place, kind, component in shown:
        written = _by_type(schema["$defs"][place])[kind]
        options = {key: option for key, option in written["properties"].items() if key != "type"}
        heading = f"{recipe_path(place)}: {kind}, {_release(kind, registry)}"
        about = (f"[bold]{escape(heading)}[/bold]", escape(written["description"]))
        yield Group(*about, _options(options), *_fields(component), "")


def _by_type(definition: Schema) -> dict[str, Schema]:
    return {one["properties"]["type"]["const"]: one for one in definition["anyOf"]}


def _release(kind: str, registry: Registry) -> str:
    return registry.plugins[kind.split("/")[0]].released_as


def recipe_path(slot: str) -> str:
    """Where in a recipe the components of `slot` are written."""
    if slot in MODEL_SLOTS:
        return f"model.{slot}"
    return f"model.decoder.{slot}" if slot in LAYER_SLOTS else slot


def _options(properties: Mapping[str, Schema]) -> Table | str:
    """A table of options, given as properties of a JSON Schema."""
    if not properties:
        return "  no options"
    table = Table("option", "type", "default", "meaning")
    for column in table.columns:
        column.overflow = "fold"
    for cells in _rows(properties):
        table.add_row(*map(escape, cells))
    return table


def _rows(properties: Mapping[str, Schema], above: str = "") -> Iterator[tuple[str, ...]]:
    """An option a row; those inside a mapping follow it, `option.inner`."""
    for name, option in properties.items():
        default = inline(option["default"]) if "default" in option else "required"
        meaning = " ".join(option.get("description", "").split())
        yield above + name, _type(option), default, meaning
        for variant in option.get("oneOf", [option]):
            yield from _rows(variant.get("properties", {}), f"{above}{name}.")


def _type(option: Schema) -> str:
    """Which values a JSON Schema allows."""
    if "$ref" in option:
        return option["$ref"].rpartition("/")[2]
    variants = option.get("anyOf", option.get("oneOf"))
    if variants:
        return " or ".join(dict.fromkeys(map(_type, variants)))
    if "const" in option or "enum" in option:
        return " or ".join(map(inline, option.get("enum", [option.get("const")])))
    if "prefixItems" in option:
        return f"[{', '.join(map(_type, option['prefixItems']))}]"
    if "items" in option:
        return f"[{_type(option['items'])}, ...]"
    kind, inner = option.get("type", "any"), option.get("additionalProperties")
    if isinstance(inner, dict):
        return f"mapping to {_type(inner)}"
    if "kind" in option.get("properties", {}):
        return f"mapping of kind {_type(option['properties']['kind'])}"
    bounds = [f"{sign} {option[key]}" for key, sign in _BOUNDS.items() if key in option]
    return f"{_WORDS.get(kind, kind)} {', '.join(bounds)}".strip()


def _fields(component: type[Component]) -> Iterator[str]:
    """What it requires and provides with default options; nothing where that is nothing."""
    config = default_config(component)
    for word, declare in (
        ("requires", component.fields_read),
        ("provides", component.fields_written),
    ):
        text = "depends on options"
        if config is not None:
            try:
                text = "; ".join(f"{name} ({spec})" for name, spec in declare(config).items())
            except Exception as error:  # code of a plugin
                text = f"fails: {type(error).__name__}: {error}"
        if text:
            yield escape(f"  {word}: {text}")
