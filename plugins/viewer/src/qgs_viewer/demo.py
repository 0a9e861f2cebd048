"""`qgs demo` and `qgs report`: trained models side by side, or a training of two; report.html."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from qgs.cli.options import (
    Device,
    Scale,
    Size,
    Threads,
    parse_size,
    scale_settings,
    use_threads,
)
from qgs_viewer.options import Photos, Runs

if TYPE_CHECKING:
    from qgs_viewer.contest import Entry
    from qgs_viewer.report import Report

MODELS = ("rooms/tokengs-64", "rooms/locus-64", "rooms/landmark-64")
ON_PHOTOS = {
    64: ("worlds/landmark-64", "worlds/locus-64", "worlds/tokengs-64"),
    128: ("worlds/landmark-128", "rooms/landmark-128", "rooms/locus-128"),
}
"""By pixels, on a user's photos; the first's training decides which photos are inputs."""
RECIPES = ("recipes/tiny/tokengs.yaml", "recipes/tiny/locus.yaml")

app = typer.Typer(help="Trained models on unseen rooms, or on your photos.")
report_app = typer.Typer(help="The report page of trained models.")


@app.command()
def demo(
    given: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[PHOTOS]",
            help="Folder of your own photos, or a video; with --train, recipe files to compare.",
        ),
    ] = None,
    models: Annotated[
        list[str] | None,
        typer.Option("--model", help="Trained model, as in qgs eval; repeatable; default: three."),
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
    size: Size = None,
    scale: Scale = None,
    threads: Threads = None,
    device: Device = "auto",
) -> None:
    """Trained models on rooms unseen in training, or on your photos; writes report.html.

    Photos without camera poses, and videos, get them first (qgs poses). With --train the
    tiny TokenGS and LocusGS, or the named recipes, are trained on the same rooms and compared.
    """
    if train and models:
        raise ValueError("--model names trained models; leave out --train, or name recipes")
    if not train and (seconds is not None or seed is not None):
        raise ValueError("--seconds and --seed are for training: add --train")
    if not train and given and given[0].endswith((".yaml", ".yml")):
        raise ValueError(f"{given[0]} is a recipe, no folder of photos: add --train to train it")
    if not train and len(given or ()) > 1:
        raise ValueError(f"one folder of photos is shown at a time, got {', '.join(given or ())}")
    if (size, scale) != (None, None) and (train or not given):
        raise ValueError("--size and --scale are for photos: name a folder, or leave them out")
    use_threads(threads)
    target = new_folder(out)
    if train:
        compare_trainings(given or RECIPES, seconds or 120, seed or 0, target, device)
    else:
        show_trained(models, given[0] if given else None, target, device, size, scale)


@report_app.command()
def report(
    runs: Runs,
    photos: Photos = None,
    out: Annotated[
        Path | None, typer.Option(help="New folder for the page; default: report, report-2, ...")
    ] = None,
    size: Size = None,
    scale: Scale = None,
    threads: Threads = None,
    device: Device = "auto",
) -> None:
    """Evaluate trained models and show their scenes side by side; writes report.html."""
    if (size, scale) != (None, None) and photos is None:
        raise ValueError("--size and --scale are for photos: give --photos, or leave them out")
    use_threads(threads)
    show_trained(runs, photos, new_folder(out, "report"), device, size, scale)


def show_trained(
    models: Sequence[str] | None,
    photos: str | None,
    target: Path,
    device: str,
    size: str | None = None,
    scale: float | None = None,
) -> None:
    """Judge `models`, by default those that come with qgs, and write their report."""
    from qgs_viewer import contest
    from qgs_viewer.hints import next_commands

    console, wanted = Console(), parse_size(size)
    side = 64 if wanted and min(wanted) < 128 else 128
    shown = models or (MODELS if photos is None else ON_PHOTOS[side])
    try:
        files = contest.checkpoints(shown)
    except FileNotFoundError as error:
        if not models:
            error.add_note("without trained models: qgs demo --train, which takes some minutes")
        raise
    scenes = "Unseen scenes" if photos is None else "Your photos"
    console.print(f"Reconstructing: {scenes.lower()}", style="dim")
    with kept_warnings() as notes:
        entries = contest.judge(files, photos, device, wanted, scale_settings(scale))
    lede = "These trained models come with qgs, and none has seen the scenes below."
    if photos is not None:
        lede = "Trained models on your photos, judged on photos beside their inputs."
    elif models:
        lede = "Trained models, judged on the test split of their recipe."
    facts = {"Training": "; ".join(entry.progress for entry in entries)}
    commands = next_commands(shown, entries, target, photos, size, scale)
    notes += show_remarks(entries, console)
    write(contest.report_of(entries, lede, facts, commands, scenes, notes), target, console)


def compare_trainings(
    recipes: Sequence[str], seconds: float, seed: int, target: Path, device: str
) -> None:
    """Train `recipes` one after the other under one budget, and write their report."""
    from qgs.train.guard import TrainingError
    from qgs_viewer import contest
    from qgs_viewer.hints import next_commands

    console, entries = Console(), []
    resolved = contest.resolve_fairly([Path(recipe) for recipe in recipes], seconds, seed)
    for number, (name, recipe) in enumerate(resolved.items(), start=1):
        console.print(f"[bold]{number}/{len(resolved)}  {name}[/bold]  {seconds:g} s of training")
        try:
            entries.append(contest.compete(name, recipe, target / name, device))
        except TrainingError as error:
            typer.echo(f"error: {error}", err=True)
            raise typer.Exit(1) from None
    facts = {"Budget": f"{seconds:g} seconds of training each, seed {seed}"}
    lede = "Trained by one command on the same scenes, judged on scenes that none of them saw."
    commands = next_commands([str(target / name) for name in resolved], entries, target)
    notes = show_remarks(entries, console)
    write(contest.report_of(entries, lede, facts, commands, notes=notes), target, console)


@contextmanager
def kept_warnings() -> Iterator[list[str]]:
    """Warnings of qgs inside the block, which are shown as well, for the page that comes of it."""
    kept, logger = list[str](), logging.getLogger("qgs")
    collector = logging.Handler(logging.WARNING)
    collector.emit = lambda record: kept.append(record.getMessage())
    # Python prints warnings itself only where no logger on the way has a handler
    handlers = [collector] if logger.hasHandlers() else [collector, logging.StreamHandler()]
    for handler in handlers:
        logger.addHandler(handler)
    try:
        yield kept
    finally:
        for handler in handlers:
            logger.removeHandler(handler)


def show_remarks(entries: Sequence[Entry], console: Console) -> list[str]:
    """Print the remarks on `entries`, and return them for the page."""
    from qgs_viewer.contest import remarks

    notes = remarks(entries)
    for note in notes:
        console.print(note, soft_wrap=True, highlight=False, markup=False)
    return notes


def write(report: Report, target: Path, console: Console) -> None:
    """Show the table; write the report and, of every model, the first scene as a PLY."""
    import torch

    from qgs.checkpoint.gaussians import save_ply
    from qgs.files import write_text
    from qgs_viewer.contest import table_of
    from qgs_viewer.report import report_html, samples_of

    console.print(table_of(report))
    for name in ("Training", "Budget"):
        if name in report.facts:
            fact = f"{name}: {report.facts[name]}"
            console.print(fact, soft_wrap=True, highlight=False, style="dim")
    page = target / "report.html"
    write_text(page, report_html(report))
    console.print(f"\n[bold]Report:[/bold] {page.resolve()}", soft_wrap=True)
    for contender in report.contenders:
        run = target / contender.name
        with torch.no_grad():
            gaussians = contender.model(samples_of(contender, report.samples)[0].inputs).gaussians
        save_ply(gaussians, run / "example.ply")
        files = run / "checkpoint.safetensors", run / "example.ply"
        there = ", ".join(str(file) for file in files if file.is_file())
        console.print(f"{contender.name}: {there}", soft_wrap=True)
    console.print("Next:")
    for command, what in report.commands.items():
        line = f"  {command}  # {what}"  # a comment to the shell, so that lines can be pasted
        console.print(line, soft_wrap=True, highlight=False, markup=False)


def new_folder(out: Path | None, name: str = "demo") -> Path:
    """`out`, refused when it holds anything; None takes the first of NAME, NAME-2, ... not used."""
    if out is None:
        names = map(Path, chain([name], (f"{name}-{number}" for number in count(2))))
        return next(name for name in names if not name.exists())
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise FileExistsError(f"{out} is not empty; choose another --out, or delete it yourself")
    return out
