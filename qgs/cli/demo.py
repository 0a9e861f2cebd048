"""`qgs demo`: train recipes side by side, compare them on unseen views, write a report."""

from __future__ import annotations

import signal
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from qgs.cli.options import Device

if TYPE_CHECKING:
    from rich.console import Console

    from qgs.cli.contest import Entry

DEFAULT_RECIPES = ("tokengs.yaml", "locus.yaml")


def register(app: typer.Typer) -> None:
    """Add the command to `app`."""
    app.command("demo")(demo)


def demo(
    recipes: Annotated[
        list[Path] | None, typer.Argument(help="Recipe files to compare; default: the tiny two.")
    ] = None,
    seconds: Annotated[float, typer.Option(min=1, help="Training time of each recipe.")] = 120,
    seed: Annotated[int, typer.Option(min=0, help="Seed of every recipe.")] = 0,
    out: Annotated[
        Path | None, typer.Option(help="New folder for everything; default: demo, demo-2, ...")
    ] = None,
    folder: Annotated[
        Path | None, typer.Option("--recipe-folder", help="Folder of the tiny recipes.")
    ] = None,
    device: Device = "auto",
) -> None:
    """Train the tiny TokenGS and LocusGS on the same rooms, compare them, write report.html."""
    files = recipes or default_recipes(folder)
    target = new_folder(out)

    from rich.console import Console

    from qgs.analysis.report import report_html
    from qgs.cli.contest import (
        StoppedError,
        compete,
        report_of,
        resolve_fairly,
        table_of,
        write_examples,
    )
    from qgs.engine import TrainingError
    from qgs.io.files import write_text

    console = Console()
    resolved = resolve_fairly(files, seconds, seed)
    entries = []
    for number, (name, recipe) in enumerate(resolved.items(), start=1):
        console.print(f"[bold]{number}/{len(resolved)}  {name}[/bold]  {seconds:g} s of training")
        try:
            entries.append(compete(name, recipe, target / name, device))
        except StoppedError as stop:
            typer.echo(f"stopped by {stop}; no report", err=True)
            raise typer.Exit(128 + signal.Signals[str(stop)]) from None
        except TrainingError as error:
            typer.echo(f"error: {error}", err=True)
            raise typer.Exit(1) from None
    console.print(table_of(entries))
    console.print("Writing the report", style="dim")
    report = report_of(entries, seconds, seed)
    write_text(target / "report.html", report_html(report))
    write_examples(report, target)
    _say_where(console, target, entries)


def default_recipes(folder: Path | None) -> list[Path]:
    """The tiny recipes in `folder`, else in ./recipes/tiny, else in the clone that qgs runs from.

    Raises FileNotFoundError that names every place where they were looked for.
    """
    import qgs

    clone = Path(qgs.__file__).parents[1]
    places = [folder] if folder else [Path("recipes/tiny"), clone / "recipes" / "tiny"]
    for place in places:
        files = [place / name for name in DEFAULT_RECIPES]
        if all(file.is_file() for file in files):
            return files
    looked = ", ".join(str(place) for place in places)
    raise FileNotFoundError(
        f"found no {' and '.join(DEFAULT_RECIPES)} in {looked}; run this in a clone of the "
        "repository, or give --recipe-folder FOLDER or the recipe files themselves"
    )


def new_folder(out: Path | None) -> Path:
    """`out`, refused when it holds anything; None takes the first of demo, demo-2, ... not used."""
    if out is None:
        number, out = 1, Path("demo")
        while out.exists():
            number += 1
            out = Path(f"demo-{number}")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise FileExistsError(f"{out} is not empty; choose another --out, or delete it yourself")
    return out


def _say_where(console: Console, target: Path, entries: Sequence[Entry]) -> None:
    console.print(f"\n[bold]Report:[/bold] {(target / 'report.html').resolve()}", soft_wrap=True)
    for entry in entries:
        run = target / entry.contender.name
        console.print(f"{entry.contender.name}: {run}/checkpoint.safetensors, {run}/example.ply")
