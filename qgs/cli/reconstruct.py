"""`qgs reconstruct`: Gaussians and pictures from a checkpoint and a folder of photos."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from qgs.cli.options import (
    Checkpoint,
    Device,
    Frames,
    Gaussians,
    Inputs,
    Scale,
    SceneName,
    Size,
    Threads,
    Tune,
    ViewsSettings,
    parse_size,
    scale_settings,
    use_threads,
)
from qgs.files import refuse_filled

if TYPE_CHECKING:
    from qgs.reconstruction.result import Reconstruction


def reconstruct(
    checkpoint: Checkpoint,
    photos: Annotated[
        str, typer.Argument(help="Folder of photos or of a data set, URL of a folder, or video.")
    ],
    out: Annotated[
        Path, typer.Option(help="Folder for results; or file for Gaussians alone: .ply, .glb, ...")
    ],
    inputs: Inputs = None,
    frames: Frames = None,
    holdout: Annotated[
        str | None,
        typer.Option(
            help="Photos to score besides the inputs, by number or file name, or `none`. Default: "
            "held-out photos (usually every 8th) near the inputs."
        ),
    ] = None,
    tune: Tune = None,
    scale: Scale = None,
    overrides: ViewsSettings = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Write into a non-empty folder, or over a file.")
    ] = False,
    size: Size = None,
    gaussians: Gaussians = None,
    scene_name: SceneName = None,
    threads: Threads = None,
    device: Device = "auto",
) -> None:
    """Reconstruct a scene from photos.

    Writes Gaussians (PLY), renderings, depth maps, an orbit and cameras. Scores held-out photos.

    `qgs refine OUT PHOTOS` then fits the Gaussians to all photos; `qgs video OUT` films.
    """
    _refuse_unusable(out, overwrite)

    from qgs.checkpoint.model_file import load
    from qgs.reconstruction.reconstruct import reconstruct as run
    from qgs.train.distributed import choose_device

    use_threads(threads)
    console = Console()
    result = run(
        load(checkpoint, choose_device(device), gaussians=gaussians),
        photos,
        inputs=inputs,
        frames=frames,
        compare=holdout,
        size=parse_size(size),
        scene=scene_name,
        overrides=[*(overrides or ()), *scale_settings(scale)],
        tune=tune,
    )
    show(result, console)
    for file in result.save(out):
        console.print(f"wrote {file}", soft_wrap=True)


def _refuse_unusable(out: Path, overwrite: bool) -> None:
    """Raise an error before any work if `out` cannot be written, or exists and is not empty.

    overwrite: True allows an `out` that exists.
    """
    # This comes before heavy imports, so that the user need not wait.
    if not overwrite:
        refuse_filled(out, "add --overwrite")

    from qgs.reconstruction.scene_formats import writer_of

    # The import of a plug-in's writer may fail.
    writer_of(out)


def show(result: "Reconstruction", console: Console) -> None:
    """Print the PSNR of model and baselines in each view, means by kind of view, and remarks."""
    from qgs.metrics.baselines import BASELINES
    from qgs.metrics.images import Psnr
    from qgs.reconstruction.result import KINDS
    from qgs.terminal import print_lines, print_table

    # A PLY shows the viewer's background through the rest.
    alpha = result.rendering.alpha.mean()
    title = f"{result.sample.scene}: {result.gaussians.count:,} Gaussians, mean alpha {alpha:.3f}"
    shown = Psnr.column.shown
    baselines = [name.replace("_", " ") for name in BASELINES]
    table = [["view", "photo", Psnr.column.heading, *baselines]]
    for kind in KINDS:
        scores = [score for score in result.scores if score.kind == kind]
        rows = [[score.psnr, *score.baselines.values()] for score in scores]
        for score, row in zip(scores, rows, strict=True):
            table.append([kind, result.sample.short_label(score.frame), *map(shown, row)])
        if rows:
            means = [shown(sum(values) / len(rows)) for values in zip(*rows, strict=True)]
            table.append([f"mean of {kind}", str(len(rows)), *means])
    print_table(console, title, table)
    if tuning := result.tuning:
        text = (
            "{steps} steps of tuning the {what}: photometric loss of the input views "
            "{loss_before:.5f} -> {loss_after:.5f}"
        )
        print_lines(console, [text.format(**tuning)])
    if result.scale:
        print_lines(console, [f"{result.scale.text}; --scale FACTOR sets another"])
    if result.size:
        print_lines(console, [f"{result.size.text}; --size HxW sets another"])
    # cameras.json has all of them
    print_lines(console, result.remarks[:3])
