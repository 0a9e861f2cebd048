"""`qgs refine`."""

from pathlib import Path
from typing import Annotated, TypeAlias

import typer

from qgs.cli.options import Device, SceneName, parse_size
from qgs_photos.commands import refuse_filled, refuse_no_time
from qgs_photos.printing import say

app = typer.Typer(help="Fit a reconstruction to the photos of its scene.")

Count: TypeAlias = Annotated[
    int | None, typer.Option(min=1, help="Number at the end; default: as many as there are.")
]


@app.command()
def refine(
    reconstruction: Annotated[Path, typer.Argument(help="Folder that `qgs reconstruct` wrote.")],
    photos: Annotated[
        str, typer.Argument(help="The photos that it was made of: a folder, its URL, or a video.")
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder for the result, or .ply/.splat file; default: RECONSTRUCTION/refined."
        ),
    ] = None,
    seconds: Annotated[float, typer.Option(help="Time of the optimisation.")] = 30.0,
    gaussians: Count = None,
    size: Annotated[
        str | None,
        typer.Option(
            metavar="HxW", help="Size of the photos; default: that of the reconstruction's."
        ),
    ] = None,
    inputs_only: Annotated[
        bool, typer.Option("--inputs-only", help="Optimise on the input photos alone.")
    ] = False,
    scene_name: SceneName = None,
    device: Device = "auto",
) -> None:
    """Optimise the Gaussians of a reconstruction on the photos of its scene.

    All photos take part but those that it was compared with and those held out of training. The
    result has the same files; both tables show scores before and after. Ctrl-C ends the
    optimisation and writes what there is.
    """
    # a result is never overwritten: minutes of work are in it
    target = out or reconstruction / "refined"
    refuse_filled(target)
    refuse_no_time("--seconds", seconds)
    pixels = parse_size(size)

    from rich.console import Console

    from qgs.cli.reconstruct import show
    from qgs.train.distributed import choose_device
    from qgs_photos.refine.reconstruction import opened_reconstruction, refine_reconstruction

    console = Console()
    start, scene, seen = opened_reconstruction(
        reconstruction, photos, pixels, scene_name, choose_device(device)
    )
    show(start, console)
    result = refine_reconstruction(start, scene, seen, seconds, gaussians, inputs_only, console)
    show(result, console)
    for file in result.save(target):
        say(console, f"wrote {file}")
