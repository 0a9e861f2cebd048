"""`qgs train` and `qgs eval`."""

from __future__ import annotations

import signal
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

import typer

if TYPE_CHECKING:
    from rich.console import Console

    from qgs.composer import Recipe
    from qgs.engine import TrainingResult
    from qgs.model import QueryGaussianModel

Overrides: TypeAlias = Annotated[
    list[str] | None,
    typer.Option("--set", help="Override, such as training.seconds=300; repeatable."),
]
Threads: TypeAlias = Annotated[
    int | None, typer.Option(min=1, help="CPU threads; all cores if not given.")
]

Device: TypeAlias = Annotated[
    str, typer.Option(help="auto, cpu or cuda; auto takes CUDA where gsplat is installed.")
]


def register(app: typer.Typer) -> None:
    """Add the commands to `app`."""
    app.command("train")(train)
    app.command("eval")(evaluate)


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

    _use_threads(threads)
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
    _evaluate(result.model, recipe, result.steps, result.folder.evaluation, console)


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

    _use_threads(threads)
    _refuse_other_sections(overrides or ())
    checkpoint = checkpoint_of(run)
    recipe = load_recipe(checkpoint)
    if overrides:
        recipe = resolve(recipe.tree, overrides)
    model = load(checkpoint, choose_device(device))
    folder = out or evaluation_folder(checkpoint.parent, bool(overrides))
    step = load_extra(checkpoint).get("step")
    _evaluate(model, recipe, None if step is None else int(step), folder, Console())


def evaluation_folder(run: Path, other: bool) -> Path:
    """RUN/evaluation; the first unused of RUN/evaluation-2, ... for `other` settings."""
    numbers = count(2)
    folder = run / "evaluation"
    while other and (folder.name == "evaluation" or folder.exists()):
        folder = run / f"evaluation-{next(numbers)}"
    return folder


def with_absolute_path(recipe: Recipe) -> Recipe:
    """`recipe` with an absolute `data.path`, so that its run can be judged from any folder."""
    from qgs.composer import resolve

    data = recipe.tree.get("data", {})
    if data.get("type") != "qgs/photos":
        return recipe
    path = str(Path(data["path"]).expanduser().resolve())
    return resolve({**recipe.tree, "data": {**data, "path": path}})


def _evaluate(
    model: QueryGaussianModel, recipe: Recipe, step: int | None, folder: Path, console: Console
) -> None:
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


def _use_threads(threads: int | None) -> None:
    if threads is not None:
        import torch

        torch.set_num_threads(threads)
