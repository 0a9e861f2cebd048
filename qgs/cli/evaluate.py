"""`qgs eval`: evaluate a checkpoint."""

import json
from itertools import count
from pathlib import Path
from typing import Annotated

import typer

from qgs.cli.options import Checkpoint, Device, Gaussians, Overrides, Threads, Tune, use_threads


def evaluate(
    run: Checkpoint,
    overrides: Overrides = None,
    index: Annotated[
        str | None,
        typer.Option(
            help="JSON file of scenes and frames to score. Default: the recipe's evaluation.index."
        ),
    ] = None,
    tune: Tune = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder for the results. Default: RUN/evaluation or, with changed settings, "
            "RUN/evaluation-N; ./evaluation_NAME for the model of a plug-in or a URL."
        ),
    ] = None,
    gaussians: Gaussians = None,
    strict: Annotated[
        bool, typer.Option("--strict", help="Exit with code 1 if a scene has no score.")
    ] = False,
    threads: Threads = None,
    device: Device = "auto",
) -> None:
    """Score a model on held-out views, beside two baselines: nearest input, mean input colour."""
    settings = list(overrides or ())
    if index is not None:
        settings.append(f"evaluation.index={json.dumps(index, ensure_ascii=False)}")

    from qgs.checkpoint.model_file import CheckpointFile
    from qgs.evaluate.evaluation import SECTIONS, evaluate_into
    from qgs.evaluate.tuning import tuning_settings
    from qgs.recipe import resolve
    from qgs.train.distributed import choose_device

    use_threads(threads)
    settings += tuning_settings(tune)
    free = (*SECTIONS, "model.feedback.rounds")
    for setting in settings:
        option = setting.split("=")[0]
        if option not in free and option.split(".")[0] not in free:
            allowed = ", ".join(free)
            raise ValueError(f"{setting} would change the trained model; change only {allowed}")
    with CheckpointFile(run, gaussians) as file:
        checkpoint = file.path
        recipe = file.recipe
        step = file.step
        model = file.model(choose_device(device))
    if settings:
        recipe = resolve(recipe.tree, settings)
        # All rounds share weights, so a trained model can run more rounds than in training.
        model.feedback.rounds = recipe.build_model("meta", pretrained=False).feedback.rounds
    # Results are written beside a checkpoint of the user's own, not into a cache.
    own = Path(run).expanduser().exists()
    folder = out or evaluation_folder(checkpoint, bool(settings or gaussians), own)
    evaluation = evaluate_into(model, recipe, step, folder)
    # Scripts need this: a mean over fewer scenes is not comparable.
    if strict and evaluation.missing:
        raise typer.Exit(1)


def evaluation_folder(checkpoint: Path, other: bool, own: bool = True) -> Path:
    """Return the default folder for results, such as RUN/evaluation for RUN/checkpoint.safetensors.

    RUN/checkpoint_ema.safetensors gets RUN/evaluation_ema. other: True if settings differ from the
    recipe; the result is the first unused folder of RUN/evaluation-2, RUN/evaluation-3 and so on.
    own: True if the checkpoint is a file of the user; False gives an unused folder in the working
    directory.
    """
    checkpoint = checkpoint if own else Path(checkpoint.name)
    label = checkpoint.stem.removeprefix("checkpoint").removeprefix("_")
    folder = checkpoint.with_name(f"evaluation_{label}" if label else "evaluation")
    if not other and (own or not folder.exists()):
        return folder
    numbered = (folder.with_name(f"{folder.name}-{number}") for number in count(2))
    return next(folder for folder in numbered if not folder.exists())
