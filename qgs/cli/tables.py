"""Tables of `qgs list` and `qgs compose`."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from rich.console import Group
from rich.markup import escape
from rich.table import Table

from qgs.checkpoint.models import about, card_of, checkpoint_path
from qgs.contracts import LAYER_SLOTS
from qgs.model import QueryGaussianModel
from qgs.model_text import parameter_counts
from qgs.recipe import Recipe
from qgs.recipe.errors import did_you_mean
from qgs.recipe.registry import Registry, default_config
from qgs.recipe.schema import recipe_schema
from qgs.recipe.sections import SETTINGS
from qgs.recipe.slots import MODEL_SLOTS, SLOTS
from qgs.recipe.yaml_text import inline

Schema = Mapping[str, Any]

_WORDS = {"string": "text", "boolean": "true or false", "object": "mapping"}
_BOUNDS = {"minimum": ">=", "exclusiveMinimum": ">", "maximum": "<=", "exclusiveMaximum": "<"}


def folded_table(title: str, *columns: str, right: int = 0) -> Table:
    """A table with folded cells; its last `right` columns are aligned to the right."""
    table = Table(title=title or None, title_justify="left")
    for index, column in enumerate(columns):
        justify = "right" if index >= len(columns) - right else "left"
        table.add_column(escape(column), overflow="fold", justify=justify)
    return table


def overview(registry: Registry) -> Iterator[Table]:
    """One table per slot: installed components, what they are, where they come from."""
    definitions = recipe_schema(registry)["$defs"]
    for name, slot in SLOTS.items():
        default = f" (default {slot.default})" if slot.default else ""
        table = folded_table(recipe_path(name) + default, "type", "meaning", "origin")
        for kind, schema in _by_type(definitions[name]).items():
            table.add_row(*map(escape, (kind, schema["description"], _release(kind, registry))))
        yield table
    if models := _models(registry):
        table = folded_table("trained models", "name", "meaning", "origin")
        for name, file in models.items():
            table.add_row(*map(escape, (name, about(file), _release(name, registry))))
        yield table


def details(name: str, registry: Registry) -> Iterator[Group]:
    """Options of a component, a slot's components or a section; file and card of a trained model.

    name: such as qgs/latent, queries, training, or rooms/locus_64; `recipe` stands for the
    settings at the top of a recipe. Raises ValueError for other names.
    """
    schema = recipe_schema(registry)
    settings = {".".join(path) or "recipe": path for path in SETTINGS}
    models, slot = _models(registry), name.removeprefix("model.").removeprefix("decoder.")
    components = [(s, kind, c) for s in SLOTS for kind, c in registry.components(s).items()]
    shown = [found for found in components if name == found[1] or slot == found[0]]
    if name in settings:
        for key in settings[name]:
            schema = schema["properties"][key]
        options = {key: schema["properties"][key] for key in SETTINGS[settings[name]].model_fields}
        described = schema.get("description", "")
        yield Group(f"[bold]{name}[/bold]", escape(described), _options(options))
    elif name in models:
        file = checkpoint_path(name)
        size = f"{file}: {file.stat().st_size / 1e6:.1f} MB"
        heading = f"[bold]{escape(name)}[/bold], {escape(_release(name, registry))}"
        yield Group(heading, escape(size), "", escape(card_of(file)))
    elif not shown:
        known = [*SLOTS, *settings, *models, *(kind for _, kind, _ in components)]
        hint = did_you_mean(name, known, "names")
        raise ValueError(f"there is no slot, component or section `{name}`; {hint}")
    for place, kind, component in shown:
        written = _by_type(schema["$defs"][place])[kind]
        options = {key: option for key, option in written["properties"].items() if key != "type"}
        heading = f"{recipe_path(place)}: {kind}, {_release(kind, registry)}"
        lines = [f"[bold]{escape(heading)}[/bold]", escape(written["description"])]
        config = default_config(component)
        declared = {"requires": component.fields_read, "provides": component.fields_written}
        fields = []
        for word, declare in declared.items():
            found = declare(config).items() if config else ()
            if text := "; ".join(f"{name} ({spec})" for name, spec in found):
                fields.append(escape(f"  {word}: {text}"))
        yield Group(*lines, _options(options), *fields, "")


def _models(registry: Registry) -> dict[str, Path]:
    """The file of every shipped model by PLUGIN/NAME."""
    return {k: file for known in registry.plugins.values() for k, file in known.models.items()}


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
    table = folded_table("", "option", "type", "default", "meaning")
    for cells in _rows(properties):
        table.add_row(*map(escape, cells))
    return table if properties else "  no options"


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


def parameter_table(recipe: Recipe, model: QueryGaussianModel) -> Table:
    """Parameters of each component of `model`, built from `recipe`."""
    table = folded_table("parameters", "component", "type", "parameters", right=1)
    counts = parameter_counts(model)
    for name, count in counts.items():
        slot = name.removeprefix("decoder.")  # of the decoder, the types in all layers
        path = ("model", slot) if slot == name else ("model", "decoder", "layers")
        places = ((p, c) for p, c in recipe.parts.items() if p[: len(path)] == path)
        kinds = dict.fromkeys(c.type for p, c in places if p[-1] == slot)
        table.add_row(name, ", ".join(kinds), f"{count:,}")
    table.add_section()
    table.add_row("total", "", f"{sum(counts.values()):,}")
    return table
