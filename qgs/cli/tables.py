"""Tables for the terminal: components, parameters, differences of recipes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from rich.markup import escape
from rich.table import Table
from torch import nn

from qgs.composer import Recipe
from qgs.composer.errors import did_you_mean
from qgs.composer.recipe import flat
from qgs.composer.registry import InstalledPlugin, default_config, load_sound_plugins
from qgs.composer.slots import LAYER_SLOTS, MODEL_SLOTS, SLOTS
from qgs.composer.yaml_text import dump
from qgs.contracts import Component, ComponentConfig, Fields


def component_tables(slot: str | None) -> tuple[list[Table], list[str]]:
    """One table per slot, or that of `slot`; and why plugins were left out.

    Raises ValueError for a slot that does not exist.
    """
    slot = slot.removeprefix("model.").removeprefix("decoder.") if slot else None
    if slot is not None and slot not in SLOTS:
        raise ValueError(f"there is no slot `{slot}`; {did_you_mean(slot, SLOTS, 'slots')}")
    registry, broken = load_sound_plugins()
    tables = []
    for name in [slot] if slot else SLOTS:
        default = SLOTS[name].default
        title = f"{recipe_path(name)} (default {default})" if default else recipe_path(name)
        table = Table(title=title, title_justify="left")
        for column in ("type", "options", "requires", "provides", "origin"):
            table.add_column(column, overflow="fold")
        for kind, component in registry.components(name).items():
            row = _row(component, registry.plugins[kind.split("/")[0]])
            table.add_row(kind, *map(escape, row))
        tables.append(table)
    return tables, broken


def recipe_path(slot: str) -> str:
    """Where in a recipe the components of `slot` are written."""
    if slot in MODEL_SLOTS:
        return f"model.{slot}"
    return f"model.decoder.{slot}" if slot in LAYER_SLOTS else slot


def parameter_table(recipe: Recipe) -> Table:
    """Parameters of each component; built on the meta device."""
    table = Table("component", "type", "parameters", title="parameters", title_justify="left")
    table.columns[2].justify = "right"
    counts = parameter_counts(recipe)
    for name, count in counts.items():
        table.add_row(name, _type_of(recipe, name), f"{count:,}")
    table.add_section()
    table.add_row("total", "", f"{sum(counts.values()):,}")
    return table


def difference_tables(first: Recipe, second: Recipe, a: str, b: str) -> list[Table]:
    """Slots, then options and settings, then parameters that differ in recipes called `a`, `b`.

    Options are compared where both recipes have the same component.
    """
    ours, theirs = flat(first.tree), flat(second.tree)
    paths = [*ours, *(path for path in theirs if path not in ours)]
    differing = [p for p in paths if ours.get(p, _MISSING) != theirs.get(p, _MISSING)]
    kinds = [path for path in differing if path.endswith(".type")]
    swapped = tuple(path.removesuffix("type") for path in kinds)
    options = [path for path in differing if not path.startswith(swapped)] if swapped else differing
    slots, values = _differences("slot", a, b), _differences("option", a, b)
    for path in kinds:
        name = path.removesuffix(".type")
        slots.add_row(name, escape(_word(ours, path)), escape(_word(theirs, path)))
    for path in options:
        values.add_row(path, escape(_word(ours, path)), escape(_word(theirs, path)))
    return [slots, values, _parameter_differences(first, second, a, b)]


def parameter_counts(recipe: Recipe) -> dict[str, int]:
    """Component to its number of parameters, decoder layers summed by slot."""
    model = recipe.build_model("meta")
    counts = {name: _count(getattr(model, name)) for name in ("encoder", "queries")}
    for name in LAYER_SLOTS[:3]:
        counts[f"decoder.{name}"] = sum(_count(getattr(layer, name)) for layer in model.decoder)
    counts["decoder.refinement"] = _count(model.refinements)
    counts["decoder.layer_scale"] = _count(model.decoder) - sum(
        counts[f"decoder.{name}"] for name in LAYER_SLOTS[:3]
    )
    return counts | {name: _count(getattr(model, name)) for name in ("head", "centers")}


_MISSING = object()


def _differences(what: str, a: str, b: str) -> Table:
    table = Table(title=f"{what}s that differ", title_justify="left")
    for header in (what, a, b):
        table.add_column(escape(header), overflow="fold")
    return table


def _parameter_differences(first: Recipe, second: Recipe, a: str, b: str) -> Table:
    table = Table(title="parameters", title_justify="left")
    table.add_column("component", overflow="fold")
    for header in (a, b, "difference"):
        table.add_column(escape(header), justify="right", overflow="fold")
    counts, others = parameter_counts(first), parameter_counts(second)
    for name, count in counts.items():
        _add_difference(table, name, count, others[name])
    table.add_section()
    _add_difference(table, "total", sum(counts.values()), sum(others.values()))
    return table


def _count(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def _type_of(recipe: Recipe, name: str) -> str:
    node: Any = recipe.tree["model"]
    for key in name.split("."):
        node = node.get(key, {}) if isinstance(node, Mapping) else {}
    kinds = [node["type"]] if isinstance(node, Mapping) and "type" in node else []
    slot = name.removeprefix("decoder.")
    for layer in recipe.tree["model"]["decoder"].get("layers", {}).values():
        kinds += [layer[slot]["type"]] if slot in layer else []
    return ", ".join(dict.fromkeys(kinds))


def _add_difference(table: Table, name: str, ours: int, theirs: int) -> None:
    table.add_row(name, f"{ours:,}", f"{theirs:,}", f"{theirs - ours:+,}" if ours != theirs else "")


def _row(component: type[Component], plugin: InstalledPlugin) -> tuple[str, ...]:
    options = []
    for name, field in component.Config.model_fields.items():
        default = "required" if field.is_required() else _plain(component, name)
        options.append(f"{name}: {default}")
    origin = f"{plugin.distribution} {plugin.version}"
    config = default_config(component)
    if config is None:
        return _lines(options), "depends on options", "depends on options", origin
    fields = [_fields(declare, config) for declare in (component.requires, component.provides)]
    return _lines(options), *fields, origin


def _fields(declare: Callable[[ComponentConfig], Fields], config: ComponentConfig) -> str:
    """Declared fields, or why a plugin's code cannot tell them."""
    try:
        return _lines(f"{name}: {spec}" for name, spec in declare(config).items())
    except Exception as error:
        return f"fails: {type(error).__name__}: {error}"


def _plain(component: type[Component], name: str) -> str:
    schema = component.Config.model_json_schema()["properties"][name]
    return _yaml(schema.get("default"))


def _word(values: Mapping[str, Any], path: str) -> str:
    return _yaml(values[path]) if path in values else "-"


def _yaml(value: Any) -> str:
    return dump(value, flow=True).removesuffix("\n").removesuffix("\n...")


def _lines(words: Iterable[str]) -> str:
    return "\n".join(words) or "-"
