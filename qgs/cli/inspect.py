"""`qgs list`, `qgs compose`, `qgs diff`, `qgs schema`: looking at recipes and components."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, TypeAlias

import typer

Overrides: TypeAlias = Annotated[
    list[str] | None,
    typer.Option("--set", help="Override, such as model.queries.count=128; repeatable."),
]


def register(app: typer.Typer) -> None:
    """Add the commands to `app`."""
    app.command("list")(list_components)
    app.command("compose")(compose)
    app.command("diff")(diff)
    app.command("schema")(schema)


def list_components(
    slot: Annotated[str | None, typer.Argument(help="Only this slot.")] = None,
) -> None:
    """Installed components by slot: options, requirements, origin."""
    from rich.console import Console

    from qgs.cli.tables import component_tables

    tables, broken = component_tables(slot)
    console = Console()
    for table in tables:
        console.print(table)
    for message in broken:
        Console(stderr=True).print(f"plugin left out: {message}", markup=False)


def compose(
    recipe: Annotated[Path, typer.Argument(help="Recipe file.")],
    overrides: Overrides = None,
) -> None:
    """The resolved recipe, where each value comes from, and parameters per component.

    The recipe goes to standard output and is valid YAML; the parameters go to standard error.
    """
    from rich.console import Console

    from qgs.cli.tables import parameter_table
    from qgs.composer import resolve
    from qgs.composer.recipe import annotated

    resolved = resolve(recipe, overrides or ())
    typer.echo(annotated(resolved))
    Console(stderr=True).print(parameter_table(resolved))


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
    from rich.console import Console

    from qgs.cli.tables import difference_tables
    from qgs.composer import resolve

    resolved = resolve(first, set_a or ()), resolve(second, set_b or ())
    names = [path.name if first.name != second.name else str(path) for path in (first, second)]
    if first == second:
        names = [f"{first.name} {letter}" for letter in "AB"]
    for table in difference_tables(*resolved, *names):
        Console().print(table)


def schema(
    out: Annotated[
        Path | None, typer.Option(help="File to write; standard output if none.")
    ] = None,
) -> None:
    """JSON Schema of a recipe with everything that is installed."""
    import json

    from qgs.composer.registry import load_sound_plugins
    from qgs.composer.schema import recipe_schema

    registry, _ = load_sound_plugins()
    text = json.dumps(recipe_schema(registry), indent=1) + "\n"
    if out is None:
        typer.echo(text, nl=False)
        return
    partial = out.with_name(out.name + ".partial")
    partial.write_text(text, encoding="utf-8")
    partial.replace(out)
