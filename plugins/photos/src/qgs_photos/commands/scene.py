"""The command `qgs scene`."""

from enum import StrEnum
from pathlib import Path
from time import perf_counter, process_time
from typing import Annotated

import typer

from qgs.cli.options import Device, Frames, Scale, SceneName, parse_size
from qgs.files import refuse_filled
from qgs_photos.commands import refuse_no_time

app = typer.Typer(help="Make the best 3D scene from photos in a given time.")


class Adjustment(StrEnum):
    """Properties of each photo that can be optimised together with the Gaussians."""

    NOTHING = "nothing"
    POSES = "poses"
    EXPOSURE = "exposure"


Minutes = Annotated[
    float,
    typer.Option(
        help="Time in minutes, from the start of the command to the last file. The first run takes "
        "up to a minute more, in which it compiles."
    ),
]
Model = Annotated[
    str | None,
    typer.Option(
        help="Trained model that makes the Gaussians to start from; none: start from depth "
        "estimated from the photos. Default: a shipped model for fewer than four photos, else none."
    ),
]
From = Annotated[
    Path | None,
    typer.Option(
        "--from",
        help="Scene to optimise further: a folder that qgs scene wrote from the same photos. "
        "Default: none; with it, --size, --gaussians and --scale-by are as in that scene. Repeat "
        "its --holdout, --masks and --adjust; corrected poses are not kept.",
    ),
]
PhotoSize = Annotated[
    str | None,
    typer.Option(
        metavar="HxW",
        help="Height and width of the photos in the optimisation. Default: chosen so that the "
        "optimisation fits into --minutes (or --seconds).",
    ),
]
Count = Annotated[
    int | None,
    typer.Option(
        min=1,
        help="Number of Gaussians. Default: chosen so that the optimisation fits into --minutes "
        "(or --seconds).",
    ),
]
Seconds = Annotated[
    float | None,
    typer.Option(help="Time of the optimisation alone in seconds; --minutes then has no effect."),
]
Holdout = Annotated[
    str,
    typer.Option(
        help="Hold out every Nth photo: leave it out of the optimisation and score the result on "
        "it. none: optimise on all photos."
    ),
]
Degree = Annotated[
    int,
    typer.Option(
        min=0,
        max=3,
        help="Degree of the spherical harmonics of colours. 0: one colour from all "
        "directions. Gaussians of --from or of a model that have harmonics keep their degree.",
    ),
]
Adjust = Annotated[
    list[Adjustment] | None,
    typer.Option(
        help="Optimise a property of each photo together with the Gaussians. poses: its camera. "
        "exposure: an affine map of its colours. Repeatable. Default: exposure if photos differ in "
        "brightness, else nothing."
    ),
]
Masks = Annotated[
    bool,
    typer.Option("--masks", help="Treat pixels outside the masks of photos as background."),
]
ScaleBy = Annotated[
    tuple[str, str, float] | None,
    typer.Option(
        metavar="A B METRES",
        help="Two points and the metres between them; files are then in metres. A point is the "
        "name of a photo, for its camera, or NAME:X,Y for what is at a pixel of a photo.",
    ),
]


@app.command()
def scene(
    photos: Annotated[str, typer.Argument(help="Folder of photos, its URL, or a video.")],
    out: Annotated[
        Path, typer.Option(help="New folder for results, or file for Gaussians: .glb, .spz, ...")
    ] = Path("scene"),
    minutes: Minutes = 5.0,
    model: Model = None,
    earlier: From = None,
    frames: Frames = None,
    scale: Scale = None,
    size: PhotoSize = None,
    gaussians: Count = None,
    seconds: Seconds = None,
    holdout: Holdout = "8",
    degree: Degree = 1,
    adjust: Adjust = None,
    masks: Masks = False,
    scale_by: ScaleBy = None,
    scene_name: SceneName = None,
    device: Device = "auto",
) -> None:
    """Make the best 3D scene from photos in a given time.

    Writes a PLY, a page, and scores on held-out photos; or one file, .glb with the photos' cameras.
    Prints chosen settings as a command. Ctrl-C ends the optimisation and writes its result.
    """
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

    options = Options(
        model=model,
        earlier=earlier,
        frames=frames,
        scale=scale,
        size=pixels,
        gaussians=gaussians,
        seconds=seconds,
        holdout=holdout,
        scene=scene_name,
        device=choose_device(device),
        extras=Extras(degree, adjust),
        masks=masks,
        scale_by=scale_by,
    )
    try:
        make_scene(photos, out, options, began, 60 * minutes, Console())
    except KeyboardInterrupt:
        typer.echo(f"{out} is not written; computed camera poses are kept for the next run")
        raise
