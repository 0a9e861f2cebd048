"""Commands `qgs view`, `qgs demo`, `qgs report` and `qgs figures`.

torch is imported only when a command runs, so that --help is fast.
"""

from enum import StrEnum, auto
from itertools import count
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from qgs.cli.options import (
    Device,
    Frames,
    Gaussians,
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
from qgs.files import refuse_existing, refuse_filled
from qgs.terminal import print_lines
from qgs.wording import listed


class FigureName(StrEnum):
    """Figures that `qgs figures` draws, in this order, by their functions in `sections`."""

    NOVEL_VIEWS = auto()
    QUERIES = auto()
    ANCHORS = auto()
    CROSS_ATTENTION = auto()
    CURVES = auto()


SourceName = Annotated[
    str,
    typer.Argument(
        help="What to show: a folder of photos, a video, a run folder, a checkpoint, a shipped "
        "model (PLUGIN/NAME), a .ply, .spz or .splat file, or a folder that qgs reconstruct or qgs "
        "scene wrote."
    ),
]
ModelPhotos = Annotated[
    str | None,
    typer.Argument(
        help="Folder of photos, or a video, that the model reconstructs. Default: a test scene of "
        "the data in the model's recipe; for shipped models, a room not seen in training."
    ),
]
Query = Annotated[
    int | None,
    typer.Option(
        min=0,
        help="Number of the query to show, from 0. Default: the viewer shows all queries, figures "
        "show a few well visible ones.",
    ),
]
Page = Annotated[
    Path | None,
    typer.Option(
        help="New HTML file to write the scene to, as a page in which a reader can turn the scene; "
        "no server is started. The page cannot change the query: choose it with --query."
    ),
]
Host = Annotated[
    str, typer.Option(help="IP address to serve at. 0.0.0.0 lets other machines open the viewer.")
]
Port = Annotated[
    int,
    typer.Option(
        min=0,
        max=65535,
        help="Port to serve at. If this port is taken, the next free port is used.",
    ),
]
OpenBrowser = Annotated[
    bool,
    typer.Option("--open/--no-open", help="Open the viewer in this machine's browser, or not."),
]
Runs = Annotated[
    list[str],
    typer.Argument(
        metavar="RUN...",
        help="Trained models: run folders, checkpoints, URLs of checkpoints, or shipped models.",
    ),
]
Photos = Annotated[
    str | None,
    typer.Option(
        help="Folder of photos, or a video, to compare the models on. Default: the data of the "
        "models' recipe; for shipped models, rooms not seen in training."
    ),
]
NewFolder = Annotated[
    Path | None,
    typer.Option(
        help="New folder for the results. Default: the name of the command, with -2, -3, ... "
        "appended if that folder exists."
    ),
]
PhotosOrRecipes = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="[PHOTOS]",
        help="Folder of your own photos, or a video. Default: rooms not seen in training. With "
        "--train, give the recipe files to compare here.",
    ),
]
Models = Annotated[
    list[str] | None,
    typer.Option(
        "--model",
        help="Trained model to compare: run folder, checkpoint, URL or shipped model. Repeatable. "
        "Default: three shipped models on unseen rooms, worlds/landmark-256 on photos.",
    ),
]
Train = Annotated[
    bool,
    typer.Option(
        "--train",
        help="Train recipes and compare the trained models, instead of shipped models. Default "
        "recipes: tiny TokenGS and tiny LocusGS.",
    ),
]
Seconds = Annotated[
    float | None,
    typer.Option(
        min=1, help="With --train: training time of each recipe in seconds. Default: 120."
    ),
]
Seed = Annotated[
    int | None,
    typer.Option(min=0, help="With --train: random seed, the same for all trainings. Default: 0."),
]
Only = Annotated[
    list[FigureName] | None, typer.Option(help="Figure to draw. Repeatable. Default: all figures.")
]

view_app = typer.Typer()
demo_app = typer.Typer()
report_app = typer.Typer()
figures_app = typer.Typer()


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

    A slider selects the decoder layer whose anchors are shown. Tick boxes select the input photos.
    """
    if foreign := [text for text in overrides or () if not text.startswith("views.")]:
        raise ValueError(
            f"--set changes only options of `views` in this command: leave out {listed(foreign)}"
        )
    # a wrong word is refused before torch is loaded, which takes seconds
    pixels = parse_size(size)

    from qgs.train.distributed import choose_device
    from qgs_viewer.opening import open_source
    from qgs_viewer.page import write_page
    from qgs_viewer.panel import serve

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
        write_page(opened.scene_of(opened.frames), query, html, console)
    else:
        serve(opened, query, host, port, show, console)


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
    gaussians: Gaussians = None,
    threads: Threads = None,
    device: Device = "auto",
) -> None:
    """Compare trained models on unseen rooms or on your photos, and write report.html.

    Camera poses are computed first (qgs poses) for a video, and for photos without poses. With
    --train, two small recipes (TokenGS and LocusGS), or the recipes that you name, are trained from
    scratch, and the trained models are compared.
    """
    if train and models:
        raise ValueError(
            "--model names trained models, which --train does not use: leave out --model or --train"
        )
    if not train and (seconds is not None or seed is not None):
        raise ValueError(
            "--seconds and --seed have an effect only with --train: add --train, or leave them out"
        )
    if not train and len(given or ()) > 1:
        raise ValueError(
            f"give at most one folder of photos or video, got {', '.join(given or ())}"
        )
    # an option without effect would look as if it had one
    if (size, scale, gaussians) != (None, None, None) and (train or not given):
        raise ValueError(
            "--size, --scale and --gaussians have an effect only on your own photos: give a folder "
            "of photos, without --train, or leave these options out"
        )
    from qgs_viewer.compare import RECIPES, compare_models, compare_trainings

    use_threads(threads)
    target = new_folder(out, "demo")
    if train:
        compare_trainings(given or RECIPES, seconds or 120, seed or 0, target, device)
    else:
        photos = given[0] if given else None
        compare_models(models, photos, target, device, size, scale, gaussians)


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
    """Evaluate trained models, and write report.html with their results side by side."""
    if (size, scale) != (None, None) and photos is None:
        raise ValueError(
            "--size and --scale have an effect only on your own photos: give --photos, or leave "
            "both options out"
        )
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
    """Draw figures that compare trained models for a paper, as PDF and PNG.

    The file figures.md explains each figure.
    """
    from qgs_viewer.comparison import open_models
    from qgs_viewer.figures import write_figures
    from qgs_viewer.remarks import scale_remarks
    from qgs_viewer.scenes import model_scenes

    folder = new_folder(out, "figures")
    models = open_models(runs, photos, device)
    shown = model_scenes(models, scene=scene)
    # before the first figure is drawn, which may take minutes
    for model in shown:
        model.scene.refuse_missing(query)
    console = Console()
    notes = [*scale_remarks(models)]
    print_lines(console, notes)
    print_lines(console, write_figures(shown, folder, only or (), query, notes))


def new_folder(out: Path | None, name: str) -> Path:
    """Return `out`; if it is None, the first of the folders NAME, NAME-2, ... that does not exist.

    Raises FileExistsError if `out` is a file or a folder that is not empty.
    """
    if out is None:
        names = (Path(f"{name}-{number}" if number > 1 else name) for number in count(1))
        return next(name for name in names if not name.exists())
    refuse_filled(out)
    return out
