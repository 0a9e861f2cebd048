"""The command `qgs refine`."""

from pathlib import Path
from typing import Annotated

import typer

from qgs.cli.options import Device, SceneName, parse_size
from qgs.files import refuse_filled
from qgs.terminal import print_lines
from qgs_photos.commands import refuse_no_time

app = typer.Typer(help="Fit a reconstruction to the photos of its scene.")

PhotoSize = Annotated[
    str | None,
    typer.Option(
        metavar="HxW",
        help="Height and width of the photos in the optimisation. Default: the size with which "
        "the reconstruction was made.",
    ),
]


@app.command()
def refine(
    reconstruction: Annotated[Path, typer.Argument(help="Folder that `qgs reconstruct` wrote.")],
    photos: Annotated[
        str,
        typer.Argument(
            help="Photos from which the reconstruction was made: a folder, its URL, or a video."
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            help="New folder, or file of Gaussians (.ply, .glb, ...), for the result. Default: "
            "RECONSTRUCTION/refined."
        ),
    ] = None,
    seconds: Annotated[float, typer.Option(help="Time of the optimisation in seconds.")] = 30.0,
    gaussians: Annotated[
        int | None,
        typer.Option(
            min=1, help="Number of Gaussians in the result. Default: that of the reconstruction."
        ),
    ] = None,
    size: PhotoSize = None,
    inputs_only: Annotated[
        bool,
        typer.Option(
            "--inputs-only",
            help="Optimise only on the input photos of the reconstruction, not on others of the "
            "scene.",
        ),
    ] = False,
    scene_name: SceneName = None,
    device: Device = "auto",
) -> None:
    """Optimise the Gaussians of a reconstruction on the photos of its scene.

    The optimisation leaves out photos held out of training, and photos that served only to score
    the reconstruction. The result has the same files as a reconstruction. Two tables show the
    scores before and after. Ctrl-C ends the optimisation early and writes its result.
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
    print_lines(console, [f"wrote {file}" for file in result.save(target)])
