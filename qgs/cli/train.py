"""`qgs train`: train a model and evaluate it."""

import signal
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from qgs.cli.inspect import RecipeFile
from qgs.cli.options import Device, Overrides, Threads, use_threads

if TYPE_CHECKING:
    from qgs.recipe import Recipe


def train(
    recipe: RecipeFile,
    out: Annotated[Path, typer.Option(help="New folder for the run. Must be empty or not exist.")],
    resume: Annotated[
        bool,
        typer.Option(
            "--resume", help="Continue the run in the folder --out; start a run if there is none."
        ),
    ] = False,
    overrides: Overrides = None,
    threads: Threads = None,
    device: Device = "auto",
) -> None:
    """Train a model, then evaluate it on held-out views.

    Ctrl-C or SIGTERM finishes the step, saves the run, and exits with code 128 + signal.
    To continue, run the same command with --resume. After a killed process, training
    continues from the last save. The result is the same as without interruption.

    On 8 GPUs:

        torchrun --standalone --nproc-per-node=8 -m qgs train RECIPE --out RUN
    """
    # Here, so that the help of all commands needs no torch.
    from qgs.evaluate.evaluation import evaluate_into
    from qgs.evaluate.plan import read_index
    from qgs.recipe import resolve
    from qgs.train.guard import TrainingError
    from qgs.train.training import train as train_model

    use_threads(threads)
    console = Console()
    resolved = with_absolute_path(resolve(recipe, overrides or ()))
    # A missing index must raise now, not after the training.
    read_index(resolved.evaluation.index)
    try:
        result = train_model(resolved, out, console=console, device=device, resume=resume)
    # The message names causes and remedies; a traceback would hide them.
    except TrainingError as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(1) from None
    # Only one of several processes prints and evaluates.
    if result.main:
        finished = result.resumed_at == result.steps
        before = "already finished: " if finished else ""
        made = f"{result.steps} steps in {result.seconds:.0f} s, {result.folder.checkpoint}"
        console.print(f"{before}{made}")
        folder = result.folder.evaluation
        if result.stopped_by:
            console.print(f"stopped early by {result.stopped_by}; not evaluated")
            console.print("continue with the same command and --resume", highlight=False)
        # The protocol is written last, so the evaluation is complete.
        elif finished and (folder / "protocol.json").exists():
            console.print(f"already evaluated, see {folder}")
        else:
            evaluate_into(result.model, resolved, result.steps, folder)
    if result.stopped_by:
        raise typer.Exit(128 + signal.Signals[result.stopped_by])


def with_absolute_path(recipe: "Recipe") -> "Recipe":
    """Return the recipe with absolute paths of data and evaluation index.

    Then `qgs eval` works in every directory.
    """
    from qgs.paths import is_local, opened_path

    tree = deepcopy(recipe.tree)
    for section, key in (("evaluation", "index"), ("data", "path"), ("data", "test_scenes")):
        # A recipe may have no data.
        options = tree.get(section) or {}
        given = options.get(key)
        if isinstance(given, str) and is_local(path := opened_path(given)):
            options[key] = str(path.resolve())
    return replace(recipe, tree=tree)
