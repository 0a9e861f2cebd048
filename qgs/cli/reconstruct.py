"""`qgs reconstruct`: from a checkpoint and a folder of photos to Gaussians and pictures."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from qgs.cli import options
from qgs.cli.options import (
    Checkpoint,
    Device,
    Frames,
    Inputs,
    NoPoses,
    Scale,
    SceneName,
    Size,
    Tune,
    ViewsSettings,
)
from qgs.extensions import function
from qgs.wording import numbered

if TYPE_CHECKING:
    from rich.console import Console

    from qgs.reconstruction.result import Reconstruction


def reconstruct(
    checkpoint: Checkpoint,
    photos: Annotated[
        str, typer.Argument(help="Folder of photos, chunks or archives, its URL, or a video.")
    ],
    out: Annotated[Path, typer.Option(help="Folder for the results, or .ply/.splat file.")],
    inputs: Inputs = None,
    frames: Frames = None,
    holdout: Annotated[
        str | None,
        typer.Option(
            help="Photos to compare with, or none; default: those near the inputs of every eighth "
            "photo, which is held out."
        ),
    ] = None,
    tune: Tune = None,
    refine: Annotated[
        float | None,
        typer.Option(
            help="Seconds of optimising the Gaussians on all photos that are not held out."
        ),
    ] = None,
    refine_size: Annotated[
        str | None,
        typer.Option(metavar="HxW", help="Size of the photos for --refine; default: the inputs'."),
    ] = None,
    refine_inputs: Annotated[
        bool, typer.Option("--refine-inputs", help="Refine on the input photos alone.")
    ] = False,
    gaussians: Annotated[
        int | None,
        typer.Option(min=1, help="Gaussians after --refine; default: as many as predicted."),
    ] = None,
    video: Annotated[
        Path | None, typer.Option(help="Video to write too, .mp4 or .webp, along --path.")
    ] = None,
    path: Annotated[
        str, typer.Option(help="Cameras of --video: orbit, spiral, walk, or a file; see qgs video.")
    ] = "orbit",
    scale: Scale = None,
    overrides: ViewsSettings = None,
    overwrite: Annotated[
        bool,
        typer.Option("--overwrite", help="Write over an earlier result or beside other files."),
    ] = False,
    size: Size = None,
    scene_name: SceneName = None,
    threads: options.Threads = None,
    no_poses: NoPoses = False,
    device: Device = "auto",
) -> None:
    """Reconstruct a scene: PLY, renders beside photos, depth, an orbit, cameras.

    Of a folder that the model was trained on, held-out photos are compared with where there are.
    For other photos the scale of the world is the one at which the model renders them best.
    The result of --refine is written to OUT/refined, beside the prediction of the model.
    """
    if not overwrite and (out.is_file() or (out.is_dir() and any(out.iterdir()))):
        raise FileExistsError(f"{out} is not empty: choose another --out, or add --overwrite")
    pixels, fine = options.parse_size(size), options.parse_size(refine_size, "--refine-size")
    if refine is None and (refine_size or refine_inputs or gaussians):
        raise ValueError("--refine-size, --refine-inputs and --gaussians need --refine SECONDS")
    if refine is not None and not 0 < refine < float("inf"):
        raise ValueError(f"--refine must be a number of seconds above 0, got {refine:g}")
    refiner = function("qgs.refiners", "reconstruction") if refine else None
    filmed = function("qgs.videos", "reconstruction")(video, path) if video else None

    from rich.console import Console

    from qgs.checkpoint.gaussians import scene_writers
    from qgs.checkpoint.model_file import load
    from qgs.recipe import resolve
    from qgs.reconstruction.scenes import chosen_scene
    from qgs.reconstruction.scenes import reconstruct as run
    from qgs.train.distributed import choose_device

    if find := scene_writers().get(out.suffix.lower()):
        find()  # one that cannot be imported is an error now, not after the work
    options.use_threads(threads)
    console = Console()
    model = load(checkpoint, choose_device(device))
    recipe = resolve(model.recipe or {}, options.tuning_settings(tune))
    tunes = tune is not None and recipe.evaluation.tuning_steps
    tuned = function("qgs.refiners", "tuned") if tunes else None
    result = run(
        model,
        photos,
        inputs=inputs,
        frames=frames,
        compare=holdout,
        size=pixels,
        scene=scene_name,
        overrides=[*(overrides or ()), *options.scale_settings(scale)],
        tune=partial(tuned, model, recipe, console) if tuned else None,
    )
    show(result, "feed-forward" if refine else "", console)
    paths, shown = result.save(out), result
    if refiner:
        scene, seen = chosen_scene(recipe, photos, fine or pixels, scene_name, holdout is None)
        more = {"count": gaussians, "inputs_only": refine_inputs, "seen": seen}
        shown = refiner(result, scene, refine, **more, console=console)
        show(shown, "refined", console)
        single = out.with_stem(f"{out.stem}_refined")
        paths += shown.save(single if paths == [out] else out / "refined")
    if filmed:
        paths.append(filmed(shown, console))
    for file in paths:
        console.print(f"wrote {file}", soft_wrap=True)


def show(result: Reconstruction, what: str, console: Console) -> None:
    """Print PSNR of all views and of the baselines, means by kind, and the remarks.

    what: put before the number of Gaussians.
    """
    from rich.table import Table

    from qgs.metrics.baselines import BASELINES
    from qgs.metrics.images import Psnr
    from qgs.reconstruction.result import KINDS

    count = f"{result.gaussians.count:,} Gaussians"
    table = Table(title=f"{result.sample.scene}: {f'{what}, {count}' if what else count}")
    table.add_column("view", no_wrap=True)
    shown = Psnr.column.shown
    for name in ("photo", Psnr.column.heading, *BASELINES):
        table.add_column(name.replace("_", " "), justify="right")
    for kind in KINDS:
        scores = [score for score in result.scores if score.kind == kind]
        rows = [[score.psnr, *score.baselines.values()] for score in scores]
        for score, row in zip(scores, rows, strict=True):
            file = Path(result.sample.names.get(score.frame, "")).name
            table.add_row(kind, numbered(score.frame, file), *map(shown, row))
        if rows:
            means = [shown(sum(values) / len(rows)) for values in zip(*rows, strict=True)]
            table.add_row(f"{kind}, mean", str(len(rows)), *means, style="bold")
            table.add_section()
    console.print(table)
    if scale := result.scale:
        found = f"{scale.text}, in {scale.seconds:.1f} s; --scale FACTOR sets another"
        console.print(found, soft_wrap=True, highlight=False, markup=False)
    for remark in result.remarks:
        console.print(remark, soft_wrap=True, highlight=False, markup=False)
