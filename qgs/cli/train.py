"""`qgs train` and `qgs eval`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, TypeAlias

import typer

Overrides: TypeAlias = Annotated[
    list[str] | None,
    typer.Option("--set", help="Override, such as training.seconds=300; repeatable."),
]
Threads: TypeAlias = Annotated[
    int | None, typer.Option(min=1, help="CPU threads; all cores if not given.")
]

EVALUATION_SECTIONS = ("data", "views", "evaluation")
"""What may differ from a checkpoint's recipe when it is evaluated."""


def register(app: typer.Typer) -> None:
    """Add the commands to `app`."""
    app.command("train")(train)
    app.command("eval")(evaluate)


def train(
    recipe: Annotated[Path, typer.Argument(help="Recipe file.")],
    out: Annotated[Path, typer.Option(help="New folder for the run; never overwritten.")],
    overrides: Overrides = None,
    threads: Threads = None,
) -> None:
    """Train a model, then evaluate it on views it never saw.

    Ctrl-C finishes the step, saves the checkpoint and ends.
    """
    from rich.console import Console

    from qgs import engine
    from qgs.composer import resolve

    _use_threads(threads)
    console = Console()
    resolved = resolve(recipe, overrides or ())
    try:
        result = engine.train(resolved, out, console=console)
    except engine.CollapseError as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(1) from None
    console.print(f"{result.steps} steps in {result.seconds:.0f} s, {result.folder.checkpoint}")
    if result.stopped_by:
        console.print(f"stopped early by {result.stopped_by}; not evaluated")
        return
    _evaluate(result.model, resolved, result.folder.evaluation, console)


def evaluate(
    run: Annotated[Path, typer.Argument(help="Run folder or checkpoint file.")],
    overrides: Overrides = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for the results; RUN/evaluation if not given.")
    ] = None,
    threads: Threads = None,
) -> None:
    """Evaluate a checkpoint on unseen views, beside the nearest input view and the mean colour."""
    import torch
    from rich.console import Console

    from qgs.composer import resolve
    from qgs.engine.folder import checkpoint_of
    from qgs.io.checkpoint import load, load_recipe

    _use_threads(threads)
    _refuse_other_sections(overrides or ())
    checkpoint = checkpoint_of(run)
    recipe = load_recipe(checkpoint)
    if overrides:
        recipe = resolve(recipe.tree, overrides)
    model = load(checkpoint, "cuda" if torch.cuda.is_available() else "cpu")
    _evaluate(model, recipe, out or checkpoint.parent / "evaluation", Console())


def _evaluate(model, recipe, folder: Path, console) -> None:
    from qgs import engine

    evaluation = engine.evaluate(model, recipe)
    evaluation.write(folder)
    evaluation.show(console)
    console.print(f"written to {folder}")


def _refuse_other_sections(overrides: list[str] | tuple[str, ...]) -> None:
    for override in overrides:
        if override.split(".")[0].split("=")[0] not in EVALUATION_SECTIONS:
            raise ValueError(
                f"--set {override} would change the trained model; an evaluation can only set "
                + ", ".join(EVALUATION_SECTIONS)
            )


def _use_threads(threads: int | None) -> None:
    if threads is not None:
        import torch

        torch.set_num_threads(threads)
