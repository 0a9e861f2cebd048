"""`qgs scene`."""

from __future__ import annotations

from pathlib import Path
from time import perf_counter, process_time
from typing import Annotated

import typer

from qgs.cli.options import Device, Frames, Scale, SceneName, parse_size

app = typer.Typer(help="The best scene of photos in a given time.")


@app.command()
def scene(
    photos: Annotated[str, typer.Argument(help="Folder of photos, its URL, or a video.")],
    out: Annotated[Path, typer.Option(help="New folder for the results.")] = Path("scene"),
    minutes: Annotated[
        float, typer.Option(help="Time for everything, from the start to the last file.")
    ] = 5.0,
    model: Annotated[
        str | None,
        typer.Option(
            help="Trained model of the start, or none; default: of fewer than four photos the best "
            "one that is installed, else none."
        ),
    ] = None,
    frames: Frames = None,
    scale: Scale = None,
    size: Annotated[
        str | None,
        typer.Option(metavar="HxW", help="Size of the photos; default: what the time allows."),
    ] = None,
    gaussians: Annotated[
        int | None, typer.Option(min=1, help="How many; default: what the time allows.")
    ] = None,
    seconds: Annotated[
        float | None,
        typer.Option(help="Time of the optimisation alone, in place of --minutes."),
    ] = None,
    holdout: Annotated[
        str, typer.Option(help="Judge every n-th photo and optimise on the others, or none.")
    ] = "8",
    degree: Annotated[
        int, typer.Option(min=0, max=3, help="Harmonics of the colours, which grow with time.")
    ] = 1,
    exposure: Annotated[
        bool, typer.Option("--exposure", help="Optimise an affine map of each photo's colours.")
    ] = False,
    refine_poses: Annotated[
        bool, typer.Option("--refine-poses", help="Optimise the cameras of the photos too.")
    ] = False,
    masks: Annotated[
        bool, typer.Option("--masks", help="What the photos' masks leave out is background.")
    ] = False,
    scene_name: SceneName = None,
    device: Device = "auto",
) -> None:
    """The best scene of photos in a given time: scene.ply, scene.splat, a page, held-out scores.

    The start is made of the photos, or of a model, and then optimised on the photos. What was
    chosen is printed as a command that makes the scene again. Ctrl-C ends the optimisation and
    writes what there is.
    """
    began = perf_counter() - process_time()  # imports took time already
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise FileExistsError(f"{out} is not empty: choose another --out, or delete it yourself")
    for option, value in (("--minutes", minutes), ("--seconds", seconds)):
        if value is not None and not 0 < value < float("inf"):
            raise ValueError(f"{option} must be a time above 0, got {value:g}")
    pixels = parse_size(size)

    from rich.console import Console

    from qgs.train.distributed import choose_device
    from qgs_photos.refine.refining import Extras
    from qgs_photos.refine.scene import Wanted, make_scene

    wanted = Wanted(
        model, frames, scale, pixels, gaussians, seconds, holdout, scene_name,
        choose_device(device), Extras(degree, exposure, refine_poses), masks,
    )  # fmt: skip
    make_scene(photos, out, wanted, began, 60 * minutes, Console())
