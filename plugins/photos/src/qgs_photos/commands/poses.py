"""The command `qgs poses`."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from qgs.cli.options import Threads
from qgs.terminal import print_lines

app = typer.Typer(help="Find camera poses of photos or a video.")

VideoFrames = Annotated[
    int | None,
    typer.Option(
        min=3,
        help="Number of frames taken from a video. Default: 40 to 240, about two for each "
        "second of the video and more in fast motion.",
    ),
]
Matching = Annotated[
    Literal["auto", "exhaustive", "sequential"],
    typer.Option(
        help="exhaustive: match all pairs of photos. sequential: match neighbours in the order "
        "of names. auto: sequential for videos and for more than 80 photos, exhaustive for up to "
        "20, else pairs of photos that look alike."
    ),
]
Side = Annotated[
    int,
    typer.Option(
        min=200, help="Longer side in pixels to which photos are reduced to find features."
    ),
]
Features = Annotated[int, typer.Option(min=100, help="Largest number of features in a photo.")]


@app.command()
def poses(
    source: Annotated[
        Path, typer.Argument(metavar="PHOTOS_OR_VIDEO", help="Folder of photos, or a video file.")
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            help="New folder for poses and images. Default: NAME_poses beside the photos or the "
            "video."
        ),
    ] = None,
    frames: VideoFrames = None,
    side: Side = 1024,
    matching: Matching = "auto",
    features: Features = 2048,
    seed: Annotated[
        int,
        typer.Option(
            min=0, help="Random seed. With --threads 1 the same seed gives the same poses."
        ),
    ] = 0,
    threads: Threads = None,
) -> None:
    """Find camera poses of photos or a video by COLMAP, and check them.

    The new folder holds the poses (sparse/0) and the images. Your photos are not changed.
    """
    from rich.console import Console

    from qgs.paths import opened_path
    from qgs_photos.datatools import check
    from qgs_photos.poses.door import beside
    from qgs_photos.poses.making import Options, make_poses

    if not source.exists():
        raise FileNotFoundError(f"{source} does not exist: give a folder of photos or a video")
    if frames is not None and not source.is_file():
        raise ValueError("--frames is for a video: leave --frames out for photos")
    console = Console()
    options = Options(frames, side, matching, features, threads or Options.threads, seed)
    folder = out or beside(source)
    found = make_poses(source, folder, options, console)
    print_lines(console, found.summary)
    with console.status("checking"):
        report = check.check(opened_path(folder), check.Options())
    print_lines(console, map(str, report.findings))
    (scene,) = report.scenes
    distance = f"median distance of matches from epipolar lines, pixels: {scene.epipolar}"
    print_lines(console, [distance, f"wrote {folder}; next: qgs demo {folder}"])
