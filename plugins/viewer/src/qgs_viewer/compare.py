"""From models or recipes that a user names to a written report."""

import logging
import signal
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import typer
from rich.console import Console

from qgs.checkpoint.models import checkpoint_path
from qgs.cli.options import parse_size, scale_settings
from qgs.recipe import Recipe
from qgs.train.distributed import choose_device
from qgs.train.folder import RunFolder
from qgs.train.guard import TrainingError
from qgs.train.training import train
from qgs_viewer.comparison import checkpoints, judge, open_models, resolve_fairly
from qgs_viewer.options import MODELS, ON_PHOTOS
from qgs_viewer.remarks import next_commands
from qgs_viewer.report import Comparison, write_report


def compare_models(
    models: Sequence[str] | None,
    photos: str | None,
    target: Path,
    device: str,
    size: str | None = None,
    scale: float | None = None,
) -> None:
    """Judge `models`, by default those that come with qgs, and write their report."""
    pixels = parse_size(size)
    # models of 128 pixels need photos of that size at least
    side = 64 if pixels and min(pixels) < 128 else 128
    names = models or (MODELS if photos is None else ON_PHOTOS[side])
    try:
        files = checkpoints(names)
    except FileNotFoundError as error:
        if not models:
            error.add_note("without trained models: qgs demo --train, which takes some minutes")
        raise
    console = Console()
    scenes = "Unseen scenes" if photos is None else "Your photos"
    console.print(f"Reconstructing: {scenes.lower()}", style="dim")
    # warnings about photos concern whoever reads the page, not only the terminal
    with kept_warnings() as warnings:
        opened = open_models(files, photos, choose_device(device), pixels, scale_settings(scale))
        results = judge(opened)
    lede = "These trained models come with qgs, and none has seen the scenes below."
    if photos is not None:
        lede = "Trained models on your photos, judged on photos beside their inputs."
    elif models:
        lede = "Trained models, judged on the test split of their recipe."
    facts = {"Training": "; ".join(f"{model.name}: {model.training}" for model in opened)}
    options = ["--size", size] if size else []
    options += ["--scale", f"{scale:g}"] if scale else []
    commands = next_commands(names, results, target, photos, options)
    write_report(Comparison(results, lede, facts, commands, scenes, warnings), target, console)


def compare_trainings(
    recipes: Sequence[str], seconds: float, seed: int, target: Path, device: str
) -> None:
    """Train `recipes` one after the other under one budget, and write their report.

    Raises typer.Exit where a training fails or is stopped.
    """
    console = Console()
    resolved = resolve_fairly([Path(recipe) for recipe in recipes], seconds, seed)
    files = {}
    for number, (name, recipe) in enumerate(resolved.items(), start=1):
        console.print(f"[bold]{number}/{len(resolved)}  {name}[/bold]  {seconds:g} s of training")
        train_or_exit(recipe, target / name, device)
        # judged as saved: from files, like all other models
        files[name] = checkpoint_path(target / name)
    results = judge(open_models(files, None, choose_device(device)))
    for result in results:
        result.evaluation.write(RunFolder(target / result.name).evaluation)
    lede = "Trained by one command on the same scenes, judged on scenes that none of them saw."
    facts = {"Budget": f"{seconds:g} seconds of training each, seed {seed}"}
    commands = next_commands([str(target / name) for name in resolved], results, target)
    write_report(Comparison(results, lede, facts, commands), target, console)


def train_or_exit(recipe: Recipe, run: Path, device: str) -> None:
    """Train one recipe. Raises typer.Exit when training failed or was stopped."""
    try:
        result = train(recipe, run, device=device)
    except TrainingError as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(1) from None
    if result.stopped_by:
        typer.echo(f"stopped by {result.stopped_by}; no report", err=True)
        # as a shell reports a process that a signal ended
        raise typer.Exit(128 + signal.Signals[result.stopped_by])


@contextmanager
def kept_warnings() -> Iterator[list[str]]:
    """Collect the warnings of qgs inside the block for the page; they are shown as well."""
    kept = list[str]()
    logger = logging.getLogger("qgs")
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
