"""`qgs view`, `qgs demo`, `qgs report` and `qgs figures`; their help waits for no torch."""

from __future__ import annotations

import socket
import webbrowser
from contextlib import suppress
from enum import StrEnum, auto
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from qgs.cli.options import (
    Device,
    Frames,
    Inputs,
    Scale,
    SceneName,
    Size,
    Threads,
    ViewsSettings,
    parse_size,
    scale_settings,
    use_threads,
)
from qgs.wording import listed

if TYPE_CHECKING:
    from qgs_viewer.opening import Source


class FigureName(StrEnum):
    """Names of the figures, in the order of figures.md."""

    NOVEL_VIEWS = auto()
    QUERIES = auto()
    ANCHORS = auto()
    CROSS_ATTENTION = auto()
    CURVES = auto()


SourceName = Annotated[
    str,
    typer.Argument(help="Run folder, checkpoint, PLUGIN/NAME, PLY, or what qgs reconstruct wrote."),
]
ModelPhotos = Annotated[
    str | None,
    typer.Argument(
        help="Photos or a video for a model; default: its recipe's data, of shipped models an "
        "unseen room."
    ),
]
Query = Annotated[
    int | None,
    typer.Option(
        min=0, help="Query to show; default: none in the viewer, notable ones in figures."
    ),
]
Page = Annotated[
    Path | None,
    typer.Option(
        help="Write the scene as one new HTML page to turn; serve nothing. Queries cannot be "
        "picked in it: --query chooses one."
    ),
]
Host = Annotated[str, typer.Option(help="Address to serve at; 0.0.0.0 lets other machines see it.")]
Port = Annotated[int, typer.Option(min=0, max=65535, help="Port, or the next free one.")]
OpenBrowser = Annotated[
    bool, typer.Option("--open/--no-open", help="Open it in the browser of this machine.")
]
Runs = Annotated[
    list[str],
    typer.Argument(
        metavar="RUN...", help="Run folders, checkpoints, their URLs, or shipped models."
    ),
]
Photos = Annotated[
    str | None,
    typer.Option(
        help="Photos and cameras; default: the recipe's data, of shipped models unseen rooms."
    ),
]
NewFolder = Annotated[
    Path | None,
    typer.Option(
        help="New folder; default: named like the command, with -2, -3, ... if it exists."
    ),
]
PhotosOrRecipes = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="[PHOTOS]",
        help="Folder of your own photos, or a video; with --train, recipe files to compare.",
    ),
]
Models = Annotated[
    list[str] | None,
    typer.Option("--model", help="Trained model, as in qgs eval; repeatable; default: three."),
]
Train = Annotated[
    bool, typer.Option("--train", help="Train and compare recipes instead, the tiny two.")
]
Seconds = Annotated[
    float | None, typer.Option(min=1, help="With --train: time of each recipe; default 120.")
]
Seed = Annotated[
    int | None, typer.Option(min=0, help="With --train: seed of every recipe; default 0.")
]
Only = Annotated[list[FigureName] | None, typer.Option(help="Draw this figure; repeatable.")]

view_app = typer.Typer(help="See a reconstruction in the browser.")
demo_app = typer.Typer(help="Trained models on unseen rooms, or on your photos.")
report_app = typer.Typer(help="The report page of trained models.")
figures_app = typer.Typer(help="Figures for a paper.")


@view_app.command()
def view(
    source: SourceName,
    photos: ModelPhotos = None,
    scene: SceneName = None,
    inputs: Inputs = None,
    frames: Frames = None,
    size: Size = None,
    scale: Scale = None,
    overrides: ViewsSettings = None,
    query: Query = None,
    html: Page = None,
    host: Host = "127.0.0.1",
    port: Port = 8080,
    show: OpenBrowser = True,
    threads: Threads = None,
    device: Device = "auto",
) -> None:
    """Show a reconstruction in the browser: turn it, pick a query, see its anchor and attention.

    Anchors are shown layer by layer, and the input photos can be changed.
    """
    if foreign := [text for text in overrides or () if not text.startswith("views.")]:
        raise ValueError(f"--set changes `views` alone here, got {listed(foreign)}: leave it out")
    # a wrong word is refused before torch is loaded, which takes seconds
    pixels = parse_size(size)

    from qgs.files import refuse_existing
    from qgs.terminal import print_lines
    from qgs.train.distributed import choose_device
    from qgs_viewer.opening import open_source

    if html is not None:
        refuse_existing(html)
    use_threads(threads)
    opened = open_source(
        source,
        choose_device(device),
        photos=photos,
        scene=scene,
        frames=frames,
        inputs=inputs,
        size=pixels,
        overrides=[*(overrides or ()), *scale_settings(scale)],
    )
    console = Console()
    print_lines(console, opened.notes)
    if html is not None:
        _write_page(opened, query, html, console)
    else:
        _serve(opened, query, host, port, show, console)


def _write_page(source: Source, query: int | None, file: Path, console: Console) -> None:
    from qgs.files import refuse_existing, write_text
    from qgs_viewer.drawing import Choice
    from qgs_viewer.page import scene_html

    scene = source.scene_of(source.frames)
    scene.refuse_missing(query)
    page = scene_html(scene, Choice(query=query, layer=scene.depth))
    # it may have come into being since the command began
    refuse_existing(file)
    write_text(file, page)
    console.print(f"wrote {file}", soft_wrap=True)
    if scene.queries:
        console.print("--query picks a query in it; without --html the viewer does.")


def _serve(
    source: Source, query: int | None, host: str, port: int, show: bool, console: Console
) -> None:
    from qgs.terminal import print_lines
    from qgs_viewer.page import quiet_server
    from qgs_viewer.panel import Panel

    with quiet_server(host, port, source.title) as server:
        panel = Panel(server, source)
        panel.scene.refuse_missing(query)
        if query is not None:
            panel.pick(query)
        # others reach this machine by its name, not by the address that stands for all
        names = {"127.0.0.1": "localhost", "0.0.0.0": socket.gethostname()}
        address = f"http://{names.get(host, host)}:{server.get_port()}"
        print_lines(console, [f"{source.title}: {address} (Ctrl-C ends it)"])
        if show:
            webbrowser.open(address)
        # Ctrl-C is how a user ends it, no error
        with suppress(KeyboardInterrupt):
            server.sleep_forever()


@demo_app.command()
def demo(
    given: PhotosOrRecipes = None,
    models: Models = None,
    train: Train = False,
    seconds: Seconds = None,
    seed: Seed = None,
    out: NewFolder = None,
    size: Size = None,
    scale: Scale = None,
    threads: Threads = None,
    device: Device = "auto",
) -> None:
    """Compare trained models on unseen rooms or on your photos, and write report.html.

    For videos and photos without camera poses, poses are made first (qgs poses). --train
    trains the tiny TokenGS and LocusGS, or the named recipes, on the same rooms instead.
    """
    if train and models:
        raise ValueError("--model names trained models; leave out --train, or name recipes")
    if not train and (seconds is not None or seed is not None):
        raise ValueError("--seconds and --seed are for training: add --train")
    if not train and len(given or ()) > 1:
        raise ValueError(f"one folder of photos is shown at a time, got {', '.join(given or ())}")
    # an option without effect would look as if it had one
    if (size, scale) != (None, None) and (train or not given):
        raise ValueError("--size and --scale are for photos: name a folder, or leave them out")
    from qgs_viewer.compare import RECIPES, compare_models, compare_trainings

    use_threads(threads)
    target = new_folder(out, "demo")
    if train:
        compare_trainings(given or RECIPES, seconds or 120, seed or 0, target, device)
    else:
        compare_models(models, given[0] if given else None, target, device, size, scale)


@report_app.command()
def report(
    runs: Runs,
    photos: Photos = None,
    out: NewFolder = None,
    size: Size = None,
    scale: Scale = None,
    threads: Threads = None,
    device: Device = "auto",
) -> None:
    """Evaluate trained models, and write report.html with their scenes side by side."""
    if (size, scale) != (None, None) and photos is None:
        raise ValueError("--size and --scale are for photos: give --photos, or leave them out")
    from qgs_viewer.compare import compare_models

    use_threads(threads)
    compare_models(runs, photos, new_folder(out, "report"), device, size, scale)


@figures_app.command()
def figures(
    runs: Runs,
    photos: Photos = None,
    scene: SceneName = None,
    query: Query = None,
    only: Only = None,
    out: NewFolder = None,
    device: Device = "auto",
) -> None:
    """Draw figures of trained models for a paper, as PDF and PNG.

    Models stand side by side; figures.md explains each figure.
    """
    from qgs.terminal import print_lines
    from qgs.train.distributed import choose_device
    from qgs_viewer.comparison import open_models
    from qgs_viewer.figures import write_figures
    from qgs_viewer.remarks import scale_remarks
    from qgs_viewer.scenes import model_scenes

    folder = new_folder(out, "figures")
    models = open_models(runs, photos, choose_device(device))
    shown = model_scenes(models, scene=scene)
    # before the first figure is drawn, which may take minutes
    for model in shown:
        model.scene.refuse_missing(query)
    console = Console()
    notes = [*scale_remarks(models)]
    print_lines(console, notes)
    print_lines(console, write_figures(shown, folder, only or (), query, notes))


def new_folder(out: Path | None, name: str) -> Path:
    """Return `out`, or the first of NAME, NAME-2, ... that does not exist.

    Raises FileExistsError where `out` holds anything.
    """
    if out is None:
        names = (Path(f"{name}-{number}" if number > 1 else name) for number in count(1))
        return next(name for name in names if not name.exists())
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise FileExistsError(f"{out} is not empty; choose another --out, or delete it yourself")
    return out
