"""`qgs diff`: where two recipes differ."""

from __future__ import annotations

from typing import Annotated

import typer

from qgs.cli.inspect import RecipeFile

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
    """Show which slots and options of two recipes differ, and what that costs in parameters.

    "-" stands for an option that a recipe's component does not have.
    """
    from rich.console import Console
    from rich.markup import escape

    from qgs.evaluate.results import print_table
    from qgs.model_text import parameter_counts
    from qgs.recipe import resolve
    from qgs.recipe.recipe import differing_options
    from qgs.wording import short_names

    ours = resolve(first, set_a or ())
    theirs = resolve(second, set_b or ())
    names = short_names([first, second])
    slots = [["slot", *names]]
    options = [["option", *names]]
    for path, values in differing_options(ours.tree, theirs.tree).items():
        # Another component has other options: first which one it is.
        rows = slots if path.endswith(".type") else options
        rows.append([path.removesuffix(".type"), *(escape(value or "-") for value in values)])
    before = parameter_counts(ours.build_model("meta"))
    after = parameter_counts(theirs.build_model("meta"))
    before["total"] = sum(before.values())
    after["total"] = sum(after.values())
    parameters = [["component", *names, "difference"]]
    for name, count in before.items():
        change = f"{after[name] - count:+,}" if after[name] != count else ""
        parameters.append([name, f"{count:,}", f"{after[name]:,}", change])
    console = Console()
    print_table(console, "slots that differ", slots)
    print_table(console, "options that differ", options)
    print_table(console, "parameters", parameters)
