"""`qgs eval`."""

from __future__ import annotations

from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from qgs.cli.options import Device, Overrides, Threads, use_threads

if TYPE_CHECKING:
    from rich.console import Console

    from qgs.composer import Recipe
    from qgs.model import QueryGaussianModel


def register(app: typer.Typer) -> None:
    """Add the command to `app`."""
    app.command("eval")(evaluate)


def evaluate(
    run: Annotated[Path, typer.Argument(help="Run folder or checkpoint file.")],
    overrides: Overrides = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder; default: RUN/evaluation, with --set the next RUN/evaluation-N."),
    ] = None,
    threads: Threads = None,
    device: Device = "auto",
) -> None:
    """Evaluate a checkpoint on unseen views, beside the nearest input view and the mean colour."""
    from rich.console import Console

    from qgs.composer import resolve
    from qgs.engine.device import choose_device
    from qgs.engine.folder import checkpoint_of
    from qgs.io.checkpoint import load, load_extra, load_recipe

    use_threads(threads)
    _refuse_other_sections(overrides or ())
    checkpoint = checkpoint_of(run)
    recipe = load_recipe(checkpoint)
    if overrides:
        recipe = resolve(recipe.tree, overrides)
    model = load(checkpoint, choose_device(device))
    folder = out or evaluation_folder(checkpoint.parent, bool(overrides))
    step = load_extra(checkpoint).get("step")
    evaluate_into(model, recipe, None if step is None else int(step), folder, Console())


def evaluation_folder(run: Path, other: bool) -> Path:
    """RUN/evaluation; the first unused of RUN/evaluation-2, ... for `other` settings."""
    numbers = count(2)
    folder = run / "evaluation"
    while other and (folder.name == "evaluation" or folder.exists()):
        folder = run / f"evaluation-{next(numbers)}"
    return folder


def evaluate_into(
    model: QueryGaussianModel, recipe: Recipe, step: int | None, folder: Path, console: Console
) -> None:
    """Evaluate `model` as `recipe` says, write the results into `folder` and show them."""
    from qgs import engine

    evaluation = engine.evaluate(model, recipe, step)
    evaluation.write(folder)
    evaluation.show(console)
    console.print(f"written to {folder}")


def _refuse_other_sections(overrides: list[str] | tuple[str, ...]) -> None:
    from qgs.engine.evaluation import SECTIONS

    for override in overrides:
        if override.split(".")[0].split("=")[0] not in SECTIONS:
            raise ValueError(
                f"--set {override} would change the trained model; an evaluation can only set "
                + ", ".join(SECTIONS)
            )
