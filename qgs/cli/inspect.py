"""`qgs compose` and `qgs recipes`: print recipes."""

from itertools import takewhile
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from qgs.cli.options import Overrides

RecipeFile = Annotated[
    Path, typer.Argument(help="Recipe file, or the name of a recipe that comes with qgs.")
]


def compose(recipe: RecipeFile, overrides: Overrides = None) -> None:
    """Print a recipe with all defaults, the origin of each value, and parameter counts.

    The recipe is printed as YAML to standard output, the parameter counts of components
    to standard error.
    """
    from qgs.model_text import parameter_counts, slot_rows
    from qgs.recipe import resolve
    from qgs.recipe.recipe import annotated
    from qgs.terminal import print_table

    resolved = resolve(recipe, overrides or ())
    model = resolved.build_model("meta")
    # This raises an error for a pattern that matches no parameter.
    resolved.rate_factors(model)
    typer.echo(annotated(resolved))
    total = f"{sum(parameter_counts(model).values()):,}"
    rows = [("component", "type", "parameters"), *slot_rows(model), ("total", "", total)]
    print_table(Console(stderr=True), "parameters", rows)
    for warning in resolved.warnings:
        typer.echo(f"warning: {warning}", err=True)


def recipes(
    name: Annotated[
        str | None, typer.Argument(help="Recipe to print, such as tiny/locus.yaml.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder for a copy of the recipe and the files it extends. Never overwrites files."
        ),
    ] = None,
) -> None:
    """List the recipes that come with qgs, or print one of them.

    All commands accept the names of these recipes. If the working directory has a file
    of the same name as a recipe, commands read the file.
    """
    from qgs.files import refuse_existing, write_text
    from qgs.recipe.files import files_of, recipe_folder
    from qgs.wording import did_you_mean

    home = recipe_folder().resolve()
    files = {*home.rglob("*.yaml")} - {*home.glob("studies/**/*")}
    known = {path.relative_to(home).as_posix(): path for path in sorted(files)}
    if name is None:
        if out:
            raise ValueError("--out needs a recipe to copy: qgs recipes NAME --out FOLDER")
        for label, path in known.items():
            lines = path.read_text(encoding="utf-8").splitlines()
            comment = takewhile(lambda line: line.startswith("#"), lines)
            first = " ".join(line.lstrip("# ") for line in comment).partition(". ")[0]
            typer.echo(f"{label:<40}  {first.rstrip('.')}".rstrip())
    elif name not in known:
        hint = did_you_mean(name, known, "recipes")
        raise ValueError(f"there is no recipe `{name}` in {home}; {hint}")
    elif out is None:
        typer.echo(known[name].read_text(encoding="utf-8"), nl=False)
    else:
        copies = {out / path.relative_to(home): path for path in files_of(known[name])}
        # If one file exists, copy none.
        for target in copies:
            refuse_existing(target)
        for target, path in copies.items():
            write_text(target, path.read_text(encoding="utf-8"))
            typer.echo(f"wrote {target}")
