"""`qgs train`."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from qgs.cli.evaluate import evaluate_into
from qgs.cli.options import Device, Overrides, Threads, use_threads

if TYPE_CHECKING:
    from rich.console import Console

    from qgs.composer import Recipe
    from qgs.engine import TrainingResult


def register(app: typer.Typer) -> None:
    """Add the command to `app`."""
    app.command("train")(train)


def train(
    recipe: Annotated[Path, typer.Argument(help="Recipe file.")],
    out: Annotated[Path, typer.Option(help="New folder for the run; never overwritten.")],
    overrides: Overrides = None,
    threads: Threads = None,
    device: Device = "auto",
) -> None:
    """Train a model, then evaluate it on views it never saw.

    Ctrl-C finishes the step, saves the checkpoint and ends with 128 + the signal's number.
    """
    from rich.console import Console

    from qgs import engine
    from qgs.composer import resolve

    use_threads(threads)
    console = Console()
    resolved = with_absolute_path(resolve(recipe, overrides or ()))
    try:
        result = engine.train(resolved, out, console=console, device=device)
    except engine.CollapseError as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(1) from None
    if result.main:
        _conclude(result, resolved, console)
    if result.stopped_by:
        raise typer.Exit(128 + signal.Signals[result.stopped_by])


def _conclude(result: TrainingResult, recipe: Recipe, console: Console) -> None:
    console.print(f"{result.steps} steps in {result.seconds:.0f} s, {result.folder.checkpoint}")
    if result.stopped_by:
        console.print(f"stopped early by {result.stopped_by}; not evaluated")
        return
    evaluate_into(result.model, recipe, result.steps, result.folder.evaluation, console)


def with_absolute_path(recipe: Recipe) -> Recipe:
    """`recipe` with absolute paths in its data, so that its run can be judged from any folder."""
    from qgs.composer import resolve
    from qgs.data.paths import is_local, opened_path

    def absolute(path: str) -> str:
        opened = opened_path(path)
        return str(opened.resolve()) if is_local(opened) else path

    data = recipe.tree.get("data", {})
    given = {key: data.get(key) for key in ("path", "test_scenes")}
    paths = {key: absolute(path) for key, path in given.items() if isinstance(path, str)}
    if not paths or not data["type"].startswith("qgs/"):
        return recipe
    return resolve({**recipe.tree, "data": {**data, **paths}})
