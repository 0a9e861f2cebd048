"""The commands `qgs data check` and `qgs data pack`."""

from typing import Annotated

import typer
from rich.console import Console
from rich.progress import Progress

from qgs.terminal import print_lines, print_table
from qgs.wording import counted

app = typer.Typer(no_args_is_help=True, help="Check and pack data sets.")

Quality = Annotated[
    int | None,
    typer.Option(
        help="JPEG quality of photos that cannot be copied unchanged. Default: write them as PNG.",
        min=1,
        max=100,
    ),
]
EveryNth = Annotated[
    int | None,
    typer.Option(
        help="Make every Nth scene a test scene. Default: keep the splits of the data set.", min=2
    ),
]
Geometry = Annotated[
    int,
    typer.Option(
        help="Number of scenes whose poses are checked by matching photos. 0: check none.", min=0
    ),
]
Format = Annotated[
    str,
    typer.Option(
        help="Check only scenes in this format, such as colmap or chunks. auto: any format."
    ),
]
SourceOptions = Annotated[
    list[str] | None,
    typer.Option(
        "--set", help="Option of the reader of the data set, such as images=images_4. Repeatable."
    ),
]
ImageSize = Annotated[
    tuple[int, int] | None,
    typer.Option(
        help="Height and width to which all images are resized. Default: no resizing.", min=1
    ),
]
TestScenes = Annotated[
    str | None,
    typer.Option(
        help="File of test scenes: an evaluation index or a list. Default: keep the splits."
    ),
]
LeaveOutBroken = Annotated[
    bool,
    typer.Option(
        help="Leave out unreadable scenes, and list them at the end. Default: stop at the first."
    ),
]
Quick = Annotated[
    bool,
    typer.Option("--quick", help="Read only image headers: decode and match no images."),
]


@app.command("check")
def check(
    path: Annotated[
        str, typer.Argument(help="Data set: a folder, an archive, a .torch chunk, or a URL.")
    ],
    index: Annotated[
        list[str] | None,
        typer.Option(
            help="Evaluation index whose scenes and frames must be in the data set. Repeatable."
        ),
    ] = None,
    format: Format = "auto",
    images: Annotated[
        str | None,
        typer.Option(
            help="Folder of photos in each scene, such as images_4. Default: depends on the format."
        ),
    ] = None,
    quick: Quick = False,
    geometry: Geometry = 20,
    threads: Annotated[int, typer.Option(help="Number of threads that decode images.", min=1)] = 8,
) -> None:
    """Find faults of a data set: one line for each fault, with scene, frame and remedy.

    Every image is decoded. Poses are checked by points that neighbouring photos share. The exit
    code is 1 for errors, and 0 for no faults or only warnings. The command imports every installed
    plugin to find the reader of PATH. With --format PLUGIN/NAME it imports only PLUGIN, and with
    --format NAME no plugin.
    """
    from qgs.paths import opened_path
    from qgs_photos.datatools.check import Options, check
    from qgs_photos.datatools.findings import errors_of

    console = Console()
    options = Options(geometry, quick, threads, format, images)
    indices = [*map(opened_path, index or [])]
    with console.status("listing scenes") as status:
        result = check(
            opened_path(path),
            options,
            indices,
            lambda done, total, name: status.update(f"{done} of {total} scenes, now {name}"),
        )
    if result.scenes:
        print_table(console, "", result.table, box=None, pad_edge=False)
    print_lines(console, map(str, result.findings))
    print_lines(console, [f"note: {note}" for note in result.notes])
    errors = len(errors_of(result.findings))
    warnings = len(result.findings) - errors
    counts = {"scene": len(result.scenes), "error": errors, "warning": warnings}
    totals = ", ".join(counted(count, what) for what, count in counts.items())
    print_lines(console, [f"{path}: {totals}"])
    if errors:
        raise typer.Exit(1)


@app.command("pack")
def pack(
    path: Annotated[
        str, typer.Argument(help="Data set, or a recipe (.yaml) whose data set is packed.")
    ],
    out: Annotated[str, typer.Option(help="New folder for the chunks, or its URL.")],
    options: SourceOptions = None,
    image_size: ImageSize = None,
    jpeg: Quality = None,
    chunk_mb: Annotated[
        int, typer.Option(help="Largest size of a chunk in mebibytes (2^20 bytes).", min=1)
    ] = 100,
    test_scenes: TestScenes = None,
    test_every: EveryNth = None,
    leave_out_broken: LeaveOutBroken = False,
) -> None:
    """Convert any data set into chunks, the format that training reads fastest.

    JPEG and PNG photos of pinhole cameras are copied unchanged. Other photos are undistorted and
    written as PNG. The same command again finishes an interrupted conversion. The command imports
    every installed plugin to find the reader of a data set; for a recipe, only the plugins that the
    recipe names.
    """
    from qgs.paths import opened_path
    from qgs_photos.datasets.dl3dv import read_scene_list
    from qgs_photos.datatools import packing
    from qgs_photos.datatools.candidates import opened_source
    from qgs_photos.datatools.entries import Encoding

    console = Console()
    if test_scenes is not None and test_every is not None:
        raise typer.BadParameter("give --test-scenes or --test-every, not both")
    source = opened_source(path, options or [], image_size)
    test = None if test_scenes is None else read_scene_list(opened_path(test_scenes))
    splits = packing.chosen_splits(source, test, test_every)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("", total=sum(map(len, splits.values())))
        packed = packing.pack(
            source,
            splits,
            opened_path(out),
            {"test_scenes": test_scenes, "test_every": test_every},
            Encoding(image_size is not None, jpeg),
            chunk_bytes=chunk_mb * 2**20,
            leave_out_broken=leave_out_broken,
            progress=lambda name: bar.update(task, advance=1, description=name),
        )
    print_lines(console, packed.told(out))
