"""`qgs recipes`: the recipes that come with qgs, and copies of them to change."""

from itertools import takewhile
from pathlib import Path
from typing import Annotated

import typer


def recipes(
    name: Annotated[
        str | None, typer.Argument(help="One of them, such as tiny/locus.yaml; shows its text.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder to copy it to, with what it extends; never overwrites."),
    ] = None,
) -> None:
    """The recipes that come with qgs; every command takes their names.

    A file of that name in the working directory comes first.
    """
    from qgs.composer.errors import did_you_mean
    from qgs.composer.files import files_of, recipe_folder

    home = recipe_folder().resolve()
    found = {path.relative_to(home).as_posix(): path for path in sorted(home.rglob("*.yaml"))}
    known = {label: path for label, path in found.items() if not label.startswith("studies/")}
    if name is None and out is None:
        width = max(map(len, known), default=0)
        for label, path in known.items():
            typer.echo(f"{label:<{width}}  {_first_comment(path)}".rstrip())
        return
    if name not in known:
        hint = did_you_mean(name, known, "recipes") if name else "give its name before --out"
        raise ValueError(f"there is no recipe `{name}` in {home}; {hint}" if name else hint)
    if out is None:
        typer.echo(known[name].read_text(encoding="utf-8"), nl=False)
        return
    _copy({out / path.relative_to(home): path for path in files_of(known[name])})


def _first_comment(path: Path) -> str:
    """The first sentence of the comment that a recipe begins with."""
    lines = path.read_text(encoding="utf-8").splitlines()
    comment = takewhile(lambda line: line.startswith("#"), lines)
    return " ".join(line.lstrip("# ") for line in comment).partition(". ")[0].rstrip(".")


def _copy(copies: dict[Path, Path]) -> None:
    """Copy files, by their targets; all of them or, where something lies, none."""
    from qgs.io.files import refuse_existing, write_text

    for target in copies:
        refuse_existing(target)
    for target, path in copies.items():
        write_text(target, path.read_text(encoding="utf-8"))
        typer.echo(f"wrote {target}")
