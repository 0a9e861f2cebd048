"""`qgs poses`."""

import os
from pathlib import Path
from typing import Annotated, Literal

import typer

from qgs.cli.options import Threads
from qgs_photos.printing import say

app = typer.Typer(help="Camera poses of photos or a video.")


@app.command()
def poses(
    source: Annotated[
        Path, typer.Argument(metavar="PHOTOS_OR_VIDEO", help="Folder of photos, or a video file.")
    ],
    out: Annotated[
        Path | None,
        typer.Option(help="New folder for poses and photos; default: NAME_poses beside them."),
    ] = None,
    frames: Annotated[
        int | None,
        typer.Option(
            min=3, help="Frames of a video; default: two a second, more of fast motion, 40 to 240."
        ),
    ] = None,
    side: Annotated[
        int, typer.Option(min=200, help="Longer side in pixels at which points are looked for.")
    ] = 1600,
    matching: Annotated[
        Literal["auto", "exhaustive", "sequential"],
        typer.Option(
            help="Match all pairs, or neighbours by name; auto: the latter for videos and above 80 "
            "photos."
        ),
    ] = "auto",
    features: Annotated[
        int, typer.Option(min=100, help="Points of a photo that are matched, at most.")
    ] = 4096,
    seed: Annotated[
        int, typer.Option(min=0, help="With --threads 1 the same seed gives the same file.")
    ] = 0,
    threads: Threads = None,
) -> None:
    """Find camera poses of photos or a video, by COLMAP: sparse/0 and images, checked at once.

    The photos stay where they are.
    """
    from rich.console import Console

    from qgs.paths import opened_path
    from qgs_photos.datatools import check
    from qgs_photos.poses.door import beside
    from qgs_photos.poses.making import Options, make_poses

    if not source.exists():
        raise FileNotFoundError(f"{source} does not exist: give photos or a video")
    if frames is not None and not source.is_file():
        raise ValueError("--frames is for a video: leave it out")
    console = Console()
    options = Options(frames, side, matching, features, threads or os.cpu_count() or 1, seed)
    folder = out or beside(source)
    for line in make_poses(source, folder, options, console).summary:
        say(console, line)
    with console.status("checking"):
        report = check.check(opened_path(folder), check.Options())
    for finding in report.findings:
        say(console, str(finding))
    (scene,) = report.scenes
    say(console, f"matched points lie {scene.epipolar} pixels from their epipolar lines")
    say(console, f"wrote {folder}; next: qgs demo {folder}")
