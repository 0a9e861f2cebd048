"""The command `qgs video`."""

from pathlib import Path
from typing import Annotated

import typer

from qgs.cli.options import SceneName, Threads, parse_size, use_threads
from qgs.terminal import print_lines

app = typer.Typer(help="Render a camera path through Gaussians as a video.")


@app.command()
def video(
    source: Annotated[
        Path,
        typer.Argument(help="Folder that qgs reconstruct or qgs scene wrote, or a PLY file."),
    ],
    photos: Annotated[
        str | None,
        typer.Argument(
            help="Photos of the scene; the camera path follows their cameras. Needed if SOURCE is "
            "a PLY file or a folder that qgs scene wrote."
        ),
    ] = None,
    out: Annotated[
        Path, typer.Option(help="New file for the video: .mp4 (H.264) or .webp.")
    ] = Path("video.mp4"),
    path: Annotated[
        str,
        typer.Option(
            help="Camera path: orbit, spiral, walk, or a file in the photos' world coordinates: a "
            "path saved by nerfstudio's viewer, or a transforms file."
        ),
    ] = "orbit",
    size: Annotated[
        str | None,
        typer.Option(
            metavar="HxW",
            help="Height and width of the video in pixels. Default: those of the photos, enlarged "
            "if their shorter side has fewer than 480 pixels.",
        ),
    ] = None,
    seconds: Annotated[
        float, typer.Option(min=0.1, help="Duration in seconds of an orbit, a spiral or a walk.")
    ] = 8.0,
    rate: Annotated[int, typer.Option(min=1, max=120, help="Frames per second.")] = 24,
    fov: Annotated[
        float | None,
        typer.Option(
            min=1, max=170, help="Vertical angle of view in degrees. Default: that of the photos."
        ),
    ] = None,
    scene: SceneName = None,
    threads: Threads = None,
) -> None:
    """Render a camera path through Gaussians as a video (mp4 or webp)."""
    from rich.console import Console

    from qgs.files import refuse_existing
    from qgs_photos.poses.filming import cameras_of, film, open_film_scene, refuse_suffix

    # before the scene is opened, which takes seconds
    refuse_existing(out)
    refuse_suffix(out)
    use_threads(threads)
    console = Console()
    pixels = parse_size(size)
    opened = open_film_scene(source, photos, scene)
    cameras = cameras_of(opened, path, pixels, round(seconds * rate), fov)
    film(opened, cameras, out, rate, console)
    print_lines(console, [f"wrote {out}"])
