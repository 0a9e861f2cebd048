"""`qgs list`, `qgs compose`, `qgs diff`, `qgs schema`: looking at recipes and components."""

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from qgs.cli.options import Overrides
from qgs.wording import short_names


def list_components(
    name: Annotated[
        str | None,
        typer.Argument(
            help="A slot, a component such as qgs/latent, a trained model, a section of settings."
        ),
    ] = None,
) -> None:
    """Installed components by slot, and trained models; with NAME all options and meanings."""
    from qgs.cli.listing import details, overview
    from qgs.composer.registry import load_sound_plugins

    registry, broken = load_sound_plugins()
    for part in details(name, registry) if name else overview(registry):
        Console().print(part, highlight=False)
    for message in broken:
        Console(stderr=True).print(f"plugin left out: {message}", markup=False)


def compose(
    recipe: Annotated[Path, typer.Argument(help="Recipe file.")], overrides: Overrides = None
) -> None:
    """The resolved recipe, where each value comes from, and parameters per component.

    The recipe goes to standard output and is valid YAML; the parameters go to standard error.
    """
    from qgs.cli.recipe_tables import parameter_table
    from qgs.composer import resolve
    from qgs.composer.recipe import annotated

    resolved = resolve(recipe, overrides or ())
    model = resolved.build_model("meta")
    resolved.rate_factors(model)  # patterns that name no parameter are refused
    typer.echo(annotated(resolved))
    Console(stderr=True).print(parameter_table(resolved, model))
    for warning in resolved.warnings:
        typer.echo(f"warning: {warning}", err=True)


def diff(
    first: Annotated[Path, typer.Argument(help="Recipe file.")],
    second: Annotated[Path, typer.Argument(help="Recipe file.")],
    set_a: Annotated[
        list[str] | None, typer.Option("--set-a", help="Override of the first; repeatable.")
    ] = None,
    set_b: Annotated[
        list[str] | None, typer.Option("--set-b", help="Override of the second; repeatable.")
    ] = None,
) -> None:
    """Which slots and options of two recipes differ, and what that costs in parameters."""
    from qgs.cli.recipe_tables import difference_tables
    from qgs.composer import resolve

    resolved = resolve(first, set_a or ()), resolve(second, set_b or ())
    for table in difference_tables(*resolved, *short_names([first, second])):
        Console().print(table)


def schema(
    out: Annotated[
        Path | None, typer.Option(help="File to write; standard output if none.")
    ] = None,
) -> None:
    """JSON Schema of a recipe with everything that is installed."""
    from qgs.composer.registry import load_sound_plugins
    from qgs.composer.schema import recipe_schema
    from qgs.io.files import write_text

    registry, _ = load_sound_plugins()
    text = json.dumps(recipe_schema(registry), indent=1) + "\n"
    if out is None:
        typer.echo(text, nl=False)
    else:
        write_text(out, text)
