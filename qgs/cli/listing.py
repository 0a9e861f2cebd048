"""What `qgs list` shows: installed components, and every option with its meaning."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from inspect import cleandoc
from typing import Any

from rich.console import Group
from rich.markup import escape
from rich.table import Table

from qgs.composer.errors import did_you_mean
from qgs.composer.registry import Registry, default_config
from qgs.composer.schema import recipe_schema
from qgs.composer.slots import LAYER_SLOTS, MODEL_SLOTS, SLOTS
from qgs.contracts import Component, ComponentConfig, Fields
from qgs.io.differences import one_line

SETTINGS = ("recipe", "model", "model.decoder", "views", "training", "evaluation")
"""Sections of a recipe that hold options besides components; `recipe` stands for its top level."""

_WORDS = {"string": "text", "boolean": "true or false", "object": "mapping"}
_BOUNDS = {"minimum": ">=", "exclusiveMinimum": ">", "maximum": "<=", "exclusiveMaximum": "<"}


def overview(registry: Registry) -> Iterator[Table]:
    """One table per slot: installed components, what they are, where they come from."""
    for slot in SLOTS:
        default = f" (default {SLOTS[slot].default})" if SLOTS[slot].default else ""
        table = Table(title=recipe_path(slot) + default, title_justify="left")
        for column in ("type", "meaning", "origin"):
            table.add_column(column, overflow="fold")
        for kind, component in registry.components(slot).items():
            origin = registry.plugins[kind.split("/")[0]].released_as
            table.add_row(escape(kind), _first_paragraph(component.__doc__), escape(origin))
        yield table


def details(name: str, registry: Registry) -> Iterator[Group]:
    """The options of a component (`qgs/latent`), of all in a slot, or of a section of settings.

    Raises ValueError when `name` is none of these.
    """
    schema = recipe_schema(registry)
    if name in SETTINGS:
        for key in name.split(".") if name != "recipe" else ():
            schema = schema["properties"][key]
        options = {k: option for k, option in schema["properties"].items() if _is_setting(option)}
        yield Group(
            f"[bold]{name}[/bold]", _first_paragraph(schema.get("description")), _options(options)
        )
        return
    slot = name.removeprefix("model.").removeprefix("decoder.")
    shown = [
        (place, kind, component)
        for place in SLOTS
        for kind, component in registry.components(place).items()
        if name == kind or slot == place
    ]
    if not shown:
        known = [*SLOTS, *SETTINGS, *(k for place in SLOTS for k in registry.components(place))]
        raise ValueError(
            f"there is no slot, component or section `{name}`; {did_you_mean(name, known, 'names')}"
        )
    for place, kind, component in shown:
        written = {o["properties"]["type"]["const"]: o for o in schema["$defs"][place]["anyOf"]}
        options = {k: o for k, o in written[kind]["properties"].items() if k != "type"}
        origin = registry.plugins[kind.split("/")[0]].released_as
        heading = f"[bold]{recipe_path(place)}: {escape(kind)}[/bold], {escape(origin)}"
        yield Group(
            heading, _first_paragraph(component.__doc__), _options(options), *_fields(component), ""
        )


def recipe_path(slot: str) -> str:
    """Where in a recipe the components of `slot` are written."""
    if slot in MODEL_SLOTS:
        return f"model.{slot}"
    return f"model.decoder.{slot}" if slot in LAYER_SLOTS else slot


def _first_paragraph(docstring: str | None) -> str:
    return escape(" ".join(cleandoc(docstring or "").partition("\n\n")[0].split()))


def _options(properties: Mapping[str, Any]) -> Table | str:
    """A table of options, given as properties of a JSON Schema."""
    if not properties:
        return "  no options"
    table = Table("option", "type", "default", "meaning")
    for column in table.columns:
        column.overflow = "fold"
    for cells in _rows(properties):
        table.add_row(*map(escape, cells))
    return table


def _rows(properties: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, ...]]:
    """An option a row; those inside a mapping follow it, `option.inner`."""
    for name, option in properties.items():
        default = one_line(option["default"]) if "default" in option else "required"
        meaning = " ".join(option.get("description", "").split())
        yield above + name, _type(option), default, meaning
        for variant in option.get("oneOf", [option]):
            yield from _rows(variant.get("properties", {}), f"{above}{name}.")


def _is_setting(option: Mapping[str, Any]) -> bool:
    """Whether it is a value, and no component or section."""
    return "default" in option or "const" in option


def _type(option: Mapping[str, Any]) -> str:
    """Which values a JSON Schema allows."""
    variants = option.get("anyOf", option.get("oneOf"))
    if variants:
        return " or ".join(dict.fromkeys(map(_type, variants)))
    if "const" in option or "enum" in option:
        return " or ".join(map(one_line, option.get("enum", [option.get("const")])))
    if "prefixItems" in option:
        return f"[{', '.join(map(_type, option['prefixItems']))}]"
    if "items" in option:
        return f"[{_type(option['items'])}, ...]"
    kind = option.get("type", "any")
    bounds = [f"{sign} {option[key]}" for key, sign in _BOUNDS.items() if key in option]
    return f"{_WORDS.get(kind, kind)} {', '.join(bounds)}".strip()


def _fields(component: type[Component]) -> Iterator[str]:
    """What it requires and provides with default options; nothing where that is nothing."""
    config = default_config(component)
    declarations = {"requires": component.requires, "provides": component.provides}
    for word, declare in declarations.items():
        if config is None:
            yield f"  {word}: depends on options"
        else:
            told = _declared(declare, config)
            yield from [escape(f"  {word}: {told}")] if told else []


def _declared(declare: Callable[[ComponentConfig], Fields], config: ComponentConfig) -> str:
    try:
        return "; ".join(f"{name} ({spec})" for name, spec in declare(config).items())
    except Exception as error:  # code of a plugin
        return f"fails: {type(error).__name__}: {error}"
