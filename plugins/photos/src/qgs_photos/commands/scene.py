"""`qgs scene`."""

from enum import StrEnum
from pathlib import Path
from time import perf_counter, process_time
from typing import Annotated, TypeAlias

import typer

from qgs.cli.options import Device, Frames, Scale, SceneName, parse_size
from qgs_photos.commands import refuse_filled, refuse_no_time

app = typer.Typer(help="The best scene of photos in a given time.")


class Adjustment(StrEnum):
    """Properties of a photo that can be optimised beside the Gaussians."""

    POSES = "poses"
    EXPOSURE = "exposure"


Minutes: TypeAlias = Annotated[
    float, typer.Option(help="Time for everything, from the start to the last file.")
]
Model: TypeAlias = Annotated[
    str | None,
    typer.Option(
        help="Trained model of the start, or none; default: of fewer than four photos a shipped "
        "one, else none."
    ),
]
PhotoSize: TypeAlias = Annotated[
    str | None,
    typer.Option(metavar="HxW", help="Size of the photos; default: what the time allows."),
]
Count: TypeAlias = Annotated[
    int | None, typer.Option(min=1, help="How many; default: what the time allows.")
]
Seconds: TypeAlias = Annotated[
    float | None, typer.Option(help="Time of the optimisation alone, in place of --minutes.")
]
Holdout: TypeAlias = Annotated[
    str, typer.Option(help="Judge every n-th photo and optimise on the others, or none.")
]
Degree: TypeAlias = Annotated[
    int, typer.Option(min=0, max=3, help="Harmonics of the colours, which grow with time.")
]
Adjust: TypeAlias = Annotated[
    list[Adjustment] | None,
    typer.Option(
        help="Optimise the camera of each photo too, or an affine map of its colours; repeatable."
    ),
]
Masks: TypeAlias = Annotated[
    bool, typer.Option("--masks", help="What the photos' masks leave out is background.")
]


@app.command()
def scene(
    photos: Annotated[str, typer.Argument(help="Folder of photos, its URL, or a video.")],
    out: Annotated[Path, typer.Option(help="New folder for the results.")] = Path("scene"),
    minutes: Minutes = 5.0,
    model: Model = None,
    frames: Frames = None,
    scale: Scale = None,
    size: PhotoSize = None,
    gaussians: Count = None,
    seconds: Seconds = None,
    holdout: Holdout = "8",
    degree: Degree = 1,
    adjust: Adjust = None,
    masks: Masks = False,
    scene_name: SceneName = None,
    device: Device = "auto",
) -> None:
    """Make the best scene of photos in a given time: PLY, .splat, a page, held-out scores.

    The start is made of the photos, or of a model, and then optimised on the photos. What was
    chosen is printed as a command that makes the scene again. Ctrl-C ends the optimisation and
    writes what there is.
    """
    # imports took time already
    began = perf_counter() - process_time()
    # what can be refused is refused before anything heavy is imported
    refuse_filled(out)
    refuse_no_time("--minutes", minutes)
    refuse_no_time("--seconds", seconds)
    pixels = parse_size(size)

    from rich.console import Console

    from qgs.train.distributed import choose_device
    from qgs_photos.refine.options import Options
    from qgs_photos.refine.refining import Extras
    from qgs_photos.refine.scene import make_scene

    adjusted = adjust or []
    extras = Extras(
        degree=degree,
        exposure=Adjustment.EXPOSURE in adjusted,
        poses=Adjustment.POSES in adjusted,
    )
    options = Options(
        model=model,
        frames=frames,
        scale=scale,
        size=pixels,
        gaussians=gaussians,
        seconds=seconds,
        holdout=holdout,
        scene=scene_name,
        device=choose_device(device),
        extras=extras,
        masks=masks,
    )
    make_scene(photos, out, options, began, 60 * minutes, Console())
