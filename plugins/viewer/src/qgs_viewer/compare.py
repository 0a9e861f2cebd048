"""Compare trained models, or train recipes and compare the results (`qgs demo`, `qgs report`)."""

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import typer
from rich.console import Console

from qgs.cli.options import parse_size, scale_settings
from qgs.train.folder import RunFolder
from qgs.train.guard import TrainingError
from qgs.train.training import train
from qgs_viewer.comparison import open_models, resolve_fairly
from qgs_viewer.opening import photo_model
from qgs_viewer.remarks import next_commands
from qgs_viewer.report import Comparison, write_report

# The shipped models that are compared on unseen rooms.
MODELS = ("rooms/tokengs-64", "rooms/locus-64", "rooms/landmark-64")
# The recipes that `qgs demo --train` trains.
RECIPES = ("recipes/tiny/tokengs.yaml", "recipes/tiny/locus.yaml")


def compare_models(
    models: Sequence[str] | None,
    photos: str | None,
    target: Path,
    device: str,
    size: str | None,
    scale: float | None,
    gaussians: int | None = None,
) -> None:
    """Evaluate `models` (default: some that come with qgs), and write a report into `target`.

    photos: folder or video; None evaluates on unseen scenes of the models' data. size: size
    of the photos, as text of the option --size; None lets the models determine it. scale: factor by
    which camera positions are multiplied; None searches for a factor. gaussians: as for `qgs.load`.
    """
    pixels = parse_size(size)
    names = models or (MODELS if photos is None else [photo_model(pixels)])
    console = Console()
    scenes = "Unseen scenes" if photos is None else "Your photos"
    # warnings about photos concern whoever reads the page, not only the terminal
    with kept_warnings() as warnings:
        opened = open_models(names, photos, device, pixels, scale_settings(scale), gaussians)
        for model in opened:
            if model.size:
                console.print(f"{model.size.text}; --size HxW sets another", style="dim")
            console.print(f"reconstructing with {model.name}", style="dim")
            # Ctrl-C during the next model, or the page, leaves these scores
            model.evaluation.write(target / model.name)
        options = ["--size", size] if size else []
        options += ["--scale", f"{scale:g}"] if scale else []
        commands = next_commands(names, opened, target, photos, options)
    trained = "; ".join(f"{model.name}: {model.step or 'not known'}" for model in opened)
    facts = {"Steps of the last training run": trained}
    write_report(Comparison(opened, facts, commands, scenes, warnings), target, console)


def compare_trainings(
    recipes: Sequence[str], seconds: float, seed: int, target: Path, device: str
) -> None:
    """Train each recipe for `seconds`, one after the other, and write a report into `target`.

    The report compares the trained models. Raises typer.Exit if a training fails, and typer.Abort
    if the user stops a training.
    """
    console = Console()
    resolved = resolve_fairly(recipes, seconds, seed)
    names = [str(target / name) for name in resolved]
    for number, (name, recipe) in enumerate(resolved.items(), start=1):
        console.print(f"[bold]{number}/{len(resolved)}  {name}[/bold]  {seconds:g} s of training")
        try:
            stopped = train(recipe, target / name, device=device).stopped_by
        except TrainingError as error:
            typer.echo(f"error: {error}", err=True)
            raise typer.Exit(1) from None
        if stopped:
            raise typer.Abort
    # judged as saved: from files, like all other models
    models = open_models(names, None, device)
    for model in models:
        model.evaluation.write(RunFolder(target / model.name).evaluation)
    facts = {"Budget": f"{seconds:g} seconds of training each, seed {seed}"}
    commands = next_commands(names, models, target)
    write_report(Comparison(models, facts, commands), target, console)


@contextmanager
def kept_warnings() -> Iterator[list[str]]:
    """Collect the warnings that qgs logs inside the block; the terminal still shows them."""
    kept = list[str]()
    logger = logging.getLogger("qgs")
    # Python prints warnings itself only where no logger on the way has a handler
    handler = logging.StreamHandler()
    handler.addFilter(lambda record: kept.append(record.getMessage()) is None)
    logger.addHandler(handler)
    try:
        yield kept
    finally:
        logger.removeHandler(handler)
