"""`qgs demo`: train recipes side by side, compare them on unseen views, write a report."""

from itertools import chain, count
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

import qgs
from qgs.cli.options import Device

DEFAULT_RECIPES = ("tokengs.yaml", "locus.yaml")


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

    from qgs.analysis.report import report_html
    from qgs.cli import contest
    from qgs.engine.guard import TrainingError
    from qgs.io.files import write_text

    console = Console()
    resolved = contest.resolve_fairly(files, seconds, seed)
    entries = []
    for number, (name, recipe) in enumerate(resolved.items(), start=1):
        console.print(f"[bold]{number}/{len(resolved)}  {name}[/bold]  {seconds:g} s of training")
        try:
            entries.append(contest.compete(name, recipe, target / name, device))
        except TrainingError as error:
            typer.echo(f"error: {error}", err=True)
            raise typer.Exit(1) from None
    console.print(contest.table_of(entries))
    console.print("Writing the report", style="dim")
    report = contest.report_of(entries, seconds, seed)
    page = target / "report.html"
    write_text(page, report_html(report))
    contest.write_examples(report, target)
    console.print(f"\n[bold]Report:[/bold] {page.resolve()}", soft_wrap=True)
    for entry in entries:
        run = target / entry.contender.name
        console.print(f"{run.name}: {run}/checkpoint.safetensors, {run}/example.ply")


def default_recipes(folder: Path | None) -> list[Path]:
    """The tiny recipes in `folder`, else in ./recipes/tiny, else in the clone that qgs runs from.

    Raises FileNotFoundError that names every place where they were looked for.
    """
    clone = Path(qgs.__file__).parents[1]
    places = [folder] if folder else [Path("recipes/tiny"), clone / "recipes" / "tiny"]
    for place in places:
        files = [place / name for name in DEFAULT_RECIPES]
        if all(file.is_file() for file in files):
            return files
    raise FileNotFoundError(
        f"found no {' and '.join(DEFAULT_RECIPES)} in {', '.join(map(str, places))}; run this in a "
        "clone of the repository, or give --recipe-folder FOLDER or the recipe files themselves"
    )


def new_folder(out: Path | None) -> Path:
    """`out`, refused when it holds anything; None takes the first of demo, demo-2, ... not used."""
    if out is None:
        names = map(Path, chain(["demo"], (f"demo-{number}" for number in count(2))))
        return next(name for name in names if not name.exists())
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise FileExistsError(f"{out} is not empty; choose another --out, or delete it yourself")
    return out
