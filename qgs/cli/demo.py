"""`qgs demo`: trained models on rooms they never saw, or on photos; or a training of two."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from qgs.cli.options import Device

if TYPE_CHECKING:
    from qgs.analysis.report import Report
    from qgs.cli.contest import Entry

MODELS = ("rooms/tokengs-64", "rooms/locus-64")
RECIPES = ("recipes/tiny/tokengs.yaml", "recipes/tiny/locus.yaml")


def demo(
    given: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[PHOTOS]",
            help="Folder of your own photos and cameras; with --train, recipe files to compare.",
        ),
    ] = None,
    models: Annotated[
        list[str] | None,
        typer.Option("--model", help="Trained model, as in qgs eval; repeatable; default: two."),
    ] = None,
    train: Annotated[
        bool, typer.Option("--train", help="Train and compare recipes instead, the tiny two.")
    ] = False,
    seconds: Annotated[
        float | None, typer.Option(min=1, help="With --train: time of each recipe; default 120.")
    ] = None,
    seed: Annotated[
        int | None, typer.Option(min=0, help="With --train: seed of every recipe; default 0.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="New folder for everything; default: demo, demo-2, ...")
    ] = None,
    device: Device = "auto",
) -> None:
    """Trained models on rooms that none has seen, or on your photos; writes report.html.

    Photos need camera poses, as Nerfstudio, COLMAP, Blender or LLFF write them.

    With --train: the tiny TokenGS and LocusGS, or the recipes that are named, trained on the same
    rooms and compared.
    """
    if train and models:
        raise ValueError("--model names trained models; leave out --train, or name recipes")
    if not train and (seconds is not None or seed is not None):
        raise ValueError("--seconds and --seed are for training: add --train")
    if not train and given and given[0].endswith((".yaml", ".yml")):
        raise ValueError(f"{given[0]} is a recipe, no folder of photos: add --train to train it")
    if not train and len(given or ()) > 1:
        raise ValueError(f"one folder of photos is shown at a time, got {', '.join(given or ())}")
    target, console = new_folder(out), Console()
    if train:
        _contest(given or RECIPES, 120 if seconds is None else seconds, seed or 0, target, device)
    else:
        show_trained(models, given[0] if given else None, target, console, device)


def show_trained(
    models: Sequence[str] | None, photos: str | None, target: Path, console: Console, device: str
) -> None:
    """Judge `models`, those that come with qgs by default, and write their report into `target`."""
    from qgs.cli import contest, trained

    try:
        files = trained.checkpoints(models or MODELS)
    except FileNotFoundError as error:
        if not models:
            error.add_note("without trained models: qgs demo --train, which takes some minutes")
        raise
    scenes = "Unseen scenes" if photos is None else "Your photos"
    console.print(f"Reconstructing: {scenes.lower()}", style="dim")
    entries = trained.judge(files, photos, device)
    lede = "These trained models come with qgs, and none has seen the scenes below."
    if photos is not None:
        lede = "Trained models on your photos, judged on those between their inputs."
    elif models:
        lede = "Trained models, judged on the test split of their recipe."
    told = trained.remarks(entries) if photos is not None else []
    facts = {"Training": trained.progress(files)}
    report = contest.report_of(entries, lede, facts, scenes, told)
    for sentence in told:
        console.print(sentence, soft_wrap=True, highlight=False, markup=False)
    console.print(contest.table_of(entries, scenes))
    console.print(f"Training: {facts['Training']}", soft_wrap=True, highlight=False, style="dim")
    _write(report, entries, target, console)


def _contest(recipes: Sequence[str], seconds: float, seed: int, target: Path, device: str) -> None:
    from qgs.cli import contest
    from qgs.engine.guard import TrainingError

    console = Console()
    resolved = contest.resolve_fairly([Path(recipe) for recipe in recipes], seconds, seed)
    entries = []
    for number, (name, recipe) in enumerate(resolved.items(), start=1):
        console.print(f"[bold]{number}/{len(resolved)}  {name}[/bold]  {seconds:g} s of training")
        try:
            entries.append(contest.compete(name, recipe, target / name, device))
        except TrainingError as error:
            typer.echo(f"error: {error}", err=True)
            raise typer.Exit(1) from None
    console.print(contest.table_of(entries))
    facts = {"Budget": f"{seconds:g} seconds of training each, seed {seed}"}
    lede = "Trained by one command on the same scenes, judged on scenes that none of them saw."
    report = contest.report_of(entries, lede, facts)
    _write(report, entries, target, console)


def _write(report: Report, entries: Sequence[Entry], target: Path, console: Console) -> None:
    """The report and an example of every model, and where they are."""
    from qgs.analysis.report import report_html
    from qgs.cli import contest
    from qgs.io.files import write_text

    console.print("Writing the report", style="dim")
    page = target / "report.html"
    write_text(page, report_html(report))
    contest.write_examples(report, target)
    console.print(f"\n[bold]Report:[/bold] {page.resolve()}", soft_wrap=True)
    for entry in entries:
        run = target / entry.contender.name
        files = run / "checkpoint.safetensors", run / "example.ply"
        there = ", ".join(str(file) for file in files if file.is_file())
        console.print(f"{entry.contender.name}: {there}", soft_wrap=True)
    console.print("Next:")
    for command, what in report.commands.items():
        console.print(f"  {command}  {what}", soft_wrap=True, highlight=False)


def new_folder(out: Path | None, name: str = "demo") -> Path:
    """`out`, refused when it holds anything; None takes the first of NAME, NAME-2, ... not used."""
    if out is None:
        names = map(Path, chain([name], (f"{name}-{number}" for number in count(2))))
        return next(name for name in names if not name.exists())
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise FileExistsError(f"{out} is not empty; choose another --out, or delete it yourself")
    return out
