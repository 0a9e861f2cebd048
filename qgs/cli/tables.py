"""Tables of `qgs list`."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from rich.console import Group
from rich.markup import escape
from rich.table import Table

from qgs.checkpoint.models import about, card_of, checkpoint_path
from qgs.contracts import LAYER_SLOTS, ComponentConfig
from qgs.recipe.errors import did_you_mean
from qgs.recipe.registry import Registry, default_config
from qgs.recipe.schema import settings_schema
from qgs.recipe.sections import SETTINGS
from qgs.recipe.slots import MODEL_SLOTS, SLOTS, summary_of
from qgs.recipe.yaml_text import inline

Schema = Mapping[str, Any]

_WORDS = {"string": "text", "boolean": "true or false", "object": "mapping"}
_BOUNDS = {"minimum": ">=", "exclusiveMinimum": ">", "maximum": "<=", "exclusiveMaximum": "<"}


def folded_table(title: str, *columns: str) -> Table:
    """Return a table with folded cells."""
    table = Table(title=title or None, title_justify="left")
    for column in columns:
        table.add_column(escape(column), overflow="fold")
    return table


def overview(registry: Registry) -> Iterator[Table]:
    """Yield a table per slot: installed components, what they are, where they come from."""
    for name, slot in SLOTS.items():
        default = f" (default {slot.default})" if slot.default else ""
        table = folded_table(recipe_path(name) + default, "type", "meaning", "origin")
        for kind, component in registry.components(name).items():
            table.add_row(*map(escape, (kind, summary_of(component), _release(kind, registry))))
        yield table
    if models := _models(registry):
        table = folded_table("trained models", "name", "meaning", "origin")
        for name, file in models.items():
            table.add_row(*map(escape, (name, about(file), _release(name, registry))))
        yield table


def details(name: str, registry: Registry) -> Iterator[Group]:
    """Explain a section of settings, a trained model, a component or the components of a slot.

    name: such as qgs/latent, queries, training, or rooms/locus_64; `recipe` stands for the
    settings at the top of a recipe. Raises ValueError for other names.
    """
    settings = {".".join(path) or "recipe": path for path in SETTINGS}
    models = _models(registry)
    slot = name.removeprefix("model.").removeprefix("decoder.")
    components = [(s, kind) for s in SLOTS for kind in registry.components(s)]
    shown = [(s, kind) for s, kind in components if name == kind or slot == s]
    if name in settings:
        config = SETTINGS[settings[name]]
        yield _explained(name, config, config)
    elif name in models:
        file = checkpoint_path(name)
        heading = f"[bold]{escape(name)}[/bold], {escape(_release(name, registry))}"
        size = f"{file}: {file.stat().st_size / 1e6:.1f} MB"
        yield Group(heading, escape(size), "", escape(card_of(file)))
    elif not shown:
        known = [*SLOTS, *settings, *models, *(kind for _, kind in components)]
        hint = did_you_mean(name, known, "names")
        raise ValueError(f"there is no slot, component or section `{name}`; {hint}")
    for place, kind in shown:
        yield _component(place, kind, registry)


def _explained(heading: str, described: type, config: type[ComponentConfig], *more: str) -> Group:
    """What `described` is, the options of `config`, and more lines."""
    options = settings_schema(config)["properties"]
    table = folded_table("", "option", "type", "default", "meaning")
    for cells in option_rows(options):
        table.add_row(*map(escape, cells))
    summary = escape(summary_of(described))
    shown = table if options else "  no options"
    return Group(f"[bold]{escape(heading)}[/bold]", summary, shown, *more)


def _component(slot: str, kind: str, registry: Registry) -> Group:
    """Explain the options of a component, and the fields that it needs and makes by default."""
    component = registry.components(slot)[kind]
    heading = f"{recipe_path(slot)}: {kind}, {_release(kind, registry)}"
    config = default_config(component)
    fields = []
    if config is not None:
        declared = {
            "requires": component.fields_read(config),
            "provides": component.fields_written(config),
        }
        for word, specs in declared.items():
            if specs:
                text = "; ".join(f"{name} ({spec})" for name, spec in specs.items())
                fields.append(escape(f"  {word}: {text}"))
    return _explained(heading, component, component.Config, *fields, "")


def _models(registry: Registry) -> dict[str, Path]:
    """Return the file of every shipped model by PLUGIN/NAME."""
    found: dict[str, Path] = {}
    for plugin in registry.plugins.values():
        found |= plugin.models
    return found


def _release(kind: str, registry: Registry) -> str:
    return registry.plugins[kind.split("/")[0]].released_as


def recipe_path(slot: str) -> str:
    """Return where in a recipe the components of `slot` are written."""
    if slot in MODEL_SLOTS:
        return f"model.{slot}"
    return f"model.decoder.{slot}" if slot in LAYER_SLOTS else slot


def option_rows(properties: Mapping[str, Schema], above: str = "") -> Iterator[tuple[str, ...]]:
    """Yield name, values, default and meaning of each option.

    Those inside a mapping follow it, `option.inner`.
    """
    for name, option in properties.items():
        default = inline(option["default"]) if "default" in option else "required"
        meaning = " ".join(option.get("description", "").split())
        yield above + name, _type(option), default, meaning
        for variant in option.get("oneOf", [option]):
            yield from option_rows(variant.get("properties", {}), f"{above}{name}.")


def _type(option: Schema) -> str:
    """Return which values a JSON Schema allows."""
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
