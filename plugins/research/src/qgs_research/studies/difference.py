"""`qgs diff`: where two recipes differ."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from qgs.cli.inspect import RecipeFile

if TYPE_CHECKING:
    from rich.table import Table

    from qgs.recipe import Recipe

app = typer.Typer(help="Compare recipes.")


@app.command()
def diff(
    first: RecipeFile,
    second: RecipeFile,
    set_a: Annotated[
        list[str] | None, typer.Option("--set-a", help="Override of the first; repeatable.")
    ] = None,
    set_b: Annotated[
        list[str] | None, typer.Option("--set-b", help="Override of the second; repeatable.")
    ] = None,
) -> None:
    """Show which slots and options of two recipes differ, and what that costs in parameters."""
    from rich.console import Console

    from qgs.recipe import resolve
    from qgs.wording import short_names

    ours = resolve(first, set_a or ())
    theirs = resolve(second, set_b or ())
    for table in difference_tables(ours, theirs, *short_names([first, second])):
        Console().print(table)


def difference_tables(first: Recipe, second: Recipe, a: str, b: str) -> list[Table]:
    """Slots, then options and settings, then parameters that differ in recipes called `a`, `b`.

    "-" stands for an option that a recipe's component does not have.
    """
    from rich.markup import escape

    from qgs.cli.tables import folded_table
    from qgs.model_text import parameter_counts
    from qgs.recipe.recipe import differing_options

    slots = folded_table("slots that differ", "slot", a, b)
    options = folded_table("options that differ", "option", a, b)
    parameters = folded_table("parameters", "component", a, b, "difference", right=3)
    for path, values in differing_options(first.tree, second.tree).items():
        # Another component has other options: first which one it is.
        table = slots if path.endswith(".type") else options
        cells = [escape("-" if value is None else value) for value in values]
        table.add_row(path.removesuffix(".type"), *cells)
    ours = parameter_counts(first.build_model("meta"))
    theirs = parameter_counts(second.build_model("meta"))
    rows = [(name, count, theirs[name]) for name, count in ours.items()]
    for name, x, y in [*rows, ("total", sum(ours.values()), sum(theirs.values()))]:
        if name == "total":
            parameters.add_section()
        parameters.add_row(name, f"{x:,}", f"{y:,}", f"{y - x:+,}" if x != y else "")
    return [slots, options, parameters]
