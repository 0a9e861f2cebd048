"""`qgs reconstruct`: from a checkpoint and a folder of photos to Gaussians and pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from qgs.cli.options import Checkpoint, Device, Size, parse_size
from qgs.wording import listed

if TYPE_CHECKING:
    from rich.table import Table

    from qgs.analysis.reconstruction import Reconstruction
    from qgs.composer import Recipe
    from qgs.contracts import Component, Scene, Split


def reconstruct(
    checkpoint: Checkpoint,
    photos: Annotated[
        str, typer.Argument(help="Folder of photos and cameras, chunks or archives, or its URL.")
    ],
    out: Annotated[Path, typer.Option(help="Folder for the results.")],
    inputs: Annotated[
        int | None, typer.Option(min=1, help="Number of input views; default: the recipe's.")
    ] = None,
    frames: Annotated[
        str | None, typer.Option(help="Input frames, such as 0,8,16; default: spread mid-folder.")
    ] = None,
    holdout: Annotated[
        str | None, typer.Option(help="Frames to compare with; default: six between the inputs.")
    ] = None,
    tune: Annotated[
        int, typer.Option(min=0, help="Steps of token tuning on the input photos; 0 for none.")
    ] = 0,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Write into a folder that is not empty.")
    ] = False,
    size: Size = None,
    scene_name: Annotated[
        str | None, typer.Option("--scene", help="Name of the scene, where there are several.")
    ] = None,
    device: Device = "auto",
) -> None:
    """Reconstruct a scene: PLY, renders beside photos, depth, an orbit, cameras.

    Of a folder that the model was trained on, held-out photos are compared with where there are.
    """
    if out.is_file():
        raise FileExistsError(f"{out} is a file; choose a folder for --out")
    if out.is_dir() and any(out.iterdir()) and not overwrite:
        raise FileExistsError(
            f"{out} is not empty; choose another --out, or add --overwrite to replace the files "
            "of the same names"
        )
    chosen, compared = frame_list(frames, "--frames"), frame_list(holdout, "--holdout")
    pixels = parse_size(size)

    from rich.console import Console

    from qgs.analysis.reconstruction import choose_sample, write_reconstruction
    from qgs.analysis.reconstruction import reconstruct as run
    from qgs.composer.registry import load_sound_plugins
    from qgs.data.domain import KEY, Domain, verdict
    from qgs.engine.distributed import choose_device
    from qgs.engine.folder import checkpoint_of
    from qgs.engine.guard import refuse_broken
    from qgs.engine.tuning import tune as fit
    from qgs.engine.tuning import tuning_loss
    from qgs.io.checkpoint import load, load_extra, load_recipe

    console = Console()
    file, device = checkpoint_of(checkpoint), choose_device(device)
    model, recipe = load(file, device), load_recipe(file)
    refuse_broken(model, file)
    registry, broken = load_sound_plugins()
    for problem in broken:
        console.print(f"left out: {problem}", highlight=False, markup=False, soft_wrap=True)
    sources = registry.components("data")
    scene, seen = chosen_scene(recipe, photos, pixels, scene_name, sources)
    sample, world = choose_sample(scene, recipe.views, inputs, chosen, compared)
    sample = replace(sample, inputs=sample.inputs.to(device), targets=sample.targets.to(device))
    gaussians = record = None
    if tune:
        rate = recipe.evaluation.tuning_rate
        tuning = fit(model, sample.inputs, tuning_loss(recipe), tune, rate)
        gaussians, before, after = tuning.prediction.gaussians, tuning.losses[0], tuning.losses[-1]
        record = {"steps": tune, "rate": rate, "loss_before": before, "loss_after": after}
        losses = f"photometric loss of the inputs {before:.5f} -> {after:.5f}"
        console.print(f"{tune} steps of token tuning: {losses}", highlight=False)
    result = run(model, sample, world, seen, gaussians, record)
    found = Domain()
    found.see(sample.inputs.cameras, sample.targets.cameras)
    sentence = verdict(load_extra(file).get(KEY), found)
    result = replace(result, likeness=sentence)
    console.print(score_table(result))
    console.print(sentence, soft_wrap=True, highlight=False)
    for path in write_reconstruction(model, result, out):
        console.print(f"wrote {path}", soft_wrap=True)


def chosen_scene(
    recipe: Recipe,
    path: str,
    size: tuple[int, int] | None,
    name: str | None,
    sources: Mapping[str, type[Component]],
) -> tuple[Scene, Sequence[int]]:
    """The scene called `name` at `path`, or the only one, and the frames a model was trained on.

    size: (H, W) of its images, the recipe's by default. sources: that may open `path`, by
    PLUGIN/NAME. Raises ValueError when there are several scenes and none is named, when none has
    the name, and for a recipe without data, which has no image size, when none is given.
    """
    from qgs.contracts import SceneSourceConfig
    from qgs.data.recognition import open_for
    from qgs.data.sampling import training_frames

    data = recipe.parts["data",].config if ("data",) in recipe.parts else None
    trained = data if isinstance(data, SceneSourceConfig) else None
    if trained is None and size is None:
        raise ValueError(
            "the checkpoint's recipe has no data, so its image size is not known; give it, "
            "such as --size 256x256"
        )
    source, is_training_data = open_for(path, size, trained, sources)
    splits: tuple[Split, ...] = ("train", "test")
    places: dict[str, tuple[Split, int]] = {
        known: (split, place) for split in splits for place, known in enumerate(source.names(split))
    }
    if name is None and len(places) == 1:
        (name,) = places
    if name not in places:
        found = f"no scene {name!r}, but" if name is not None else f"{len(places)} scenes:"
        raise ValueError(f"{path} holds {found} {listed(places)}: name one of them with --scene")
    split, place = places[name]
    scene = source.scenes(split)[place]
    seen = is_training_data and scene.name in source.names("train")
    return scene, training_frames(scene) if seen else ()


def frame_list(text: str | None, option: str) -> list[int] | None:
    """Frame numbers of "0,8,16"; None stays None. Raises ValueError for anything else."""
    if text is None:
        return None
    try:
        return [int(part) for part in text.split(",")]
    except ValueError:
        raise ValueError(
            f"{option} takes frame numbers with commas between, such as 0,8,16; got {text!r}"
        ) from None


def score_table(result: Reconstruction) -> Table:
    """PSNR of every rendered view and of the baselines, inputs first, and the means by kind."""
    from rich.table import Table

    from qgs.analysis.reconstruction import KINDS
    from qgs.metrics.baselines import BASELINES
    from qgs.metrics.images import Psnr

    table = Table(title=f"{result.sample.scene}: {result.gaussians.count:,} Gaussians")
    table.add_column("view")
    shown = Psnr.column.shown
    for name in ("frames", Psnr.column.heading, *BASELINES):
        table.add_column(name.replace("_", " "), justify="right")
    for kind in KINDS:
        scores = [score for score in result.scores if score.kind == kind]
        rows = [[score.psnr, *score.baselines.values()] for score in scores]
        for score, row in zip(scores, rows, strict=True):
            table.add_row(kind, str(score.frame), *map(shown, row))
        if rows:
            means = [shown(sum(values) / len(rows)) for values in zip(*rows, strict=True)]
            table.add_row(f"{kind}, mean", str(len(rows)), *means, style="bold")
            table.add_section()
    return table
