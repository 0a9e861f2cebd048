"""Commands `qgs list` and `qgs schema`, which show installed components and their options."""

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

list_app = typer.Typer()
schema_app = typer.Typer()


@list_app.command()
def list_components(
    name: Annotated[
        str | None,
        typer.Argument(
            help="Name to explain: a slot, component, trained model or section of settings."
        ),
    ] = None,
) -> None:
    """List installed components by slot, and trained models. With NAME, explain its options.

    All installed plugins are imported; for a NAME such as rooms/locus-64, only the plugin `rooms`.
    """
    from qgs.recipe.registry import Registry, load_plugin, load_usable_plugins
    from qgs_dev.schema import details, overview

    plugin, slash, _ = (name or "").partition("/")
    # A name such as rooms/locus-64 needs one plugin only; importing all takes seconds.
    if slash:
        registry = Registry({name: load_plugin(name) for name in ("qgs", plugin)})
        broken = list[str]()
    else:
        registry, broken = load_usable_plugins()
    for part in details(name, registry) if name else overview(registry):
        Console().print(part, highlight=False)
    for message in broken:
        Console(stderr=True).print(f"a plugin is left out: {message}", markup=False)


@schema_app.command()
def schema(
    out: Annotated[
        Path | None, typer.Option(help="File to write. Default: print to standard output.")
    ] = None,
) -> None:
    """Write the JSON Schema of recipes with all installed components.

    The command imports every installed plugin.
    """
    from qgs.files import write_text
    from qgs.recipe.registry import load_usable_plugins
    from qgs_dev.schema import recipe_schema

    text = json.dumps(recipe_schema(load_usable_plugins()[0]), indent=1) + "\n"
    if out is None:
        typer.echo(text, nl=False)
    else:
        write_text(out, text)
