"""Options of the viewer's commands, and the models that they take; none of it needs torch."""

from enum import StrEnum, auto
from pathlib import Path
from typing import Annotated, TypeAlias

import typer


class FigureName(StrEnum):
    """Names of the figures, in the order of figures.md."""

    NOVEL_VIEWS = auto()
    QUERIES = auto()
    ANCHORS = auto()
    CROSS_ATTENTION = auto()
    CURVES = auto()


# The shipped models that are compared on unseen rooms.
MODELS = ("rooms/tokengs-64", "rooms/locus-64", "rooms/landmark-64")
ON_PHOTOS = {
    64: ("worlds/landmark-64", "worlds/locus-64", "worlds/tokengs-64"),
    128: ("worlds/landmark-128", "rooms/landmark-128", "rooms/locus-128"),
}
"""By pixels, on a user's photos; the first's training decides which photos are inputs."""
# The recipes that `qgs demo --train` trains.
RECIPES = ("recipes/tiny/tokengs.yaml", "recipes/tiny/locus.yaml")
Source: TypeAlias = Annotated[
    str,
    typer.Argument(help="Run folder, checkpoint, PLUGIN/NAME, PLY, or what qgs reconstruct wrote."),
]
ModelPhotos: TypeAlias = Annotated[
    str | None,
    typer.Argument(
        help="Photos or a video for a model; default: its recipe's data, of shipped models an "
        "unseen room."
    ),
]
Query: TypeAlias = Annotated[
    int | None,
    typer.Option(
        min=0, help="Query to show; default: none in the viewer, notable ones in figures."
    ),
]
Page: TypeAlias = Annotated[
    Path | None,
    typer.Option(
        help="Write the scene as one new HTML page to turn; serve nothing. Queries cannot be "
        "picked in it: --query chooses one."
    ),
]
Host: TypeAlias = Annotated[
    str, typer.Option(help="Address to serve at; 0.0.0.0 lets other machines see it.")
]
Port: TypeAlias = Annotated[int, typer.Option(min=0, max=65535, help="Port, or the next free one.")]
Open: TypeAlias = Annotated[
    bool, typer.Option("--open/--no-open", help="Open it in the browser of this machine.")
]
Runs: TypeAlias = Annotated[
    list[str],
    typer.Argument(
        metavar="RUN...", help="Run folders, checkpoints, their URLs, or shipped models."
    ),
]
Photos: TypeAlias = Annotated[
    str | None,
    typer.Option(
        help="Photos and cameras; default: the recipe's data, of shipped models unseen rooms."
    ),
]
NewFolder: TypeAlias = Annotated[
    Path | None,
    typer.Option(
        help="New folder; default: named like the command, with -2, -3, ... if it exists."
    ),
]
PhotosOrRecipes: TypeAlias = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="[PHOTOS]",
        help="Folder of your own photos, or a video; with --train, recipe files to compare.",
    ),
]
Models: TypeAlias = Annotated[
    list[str] | None,
    typer.Option("--model", help="Trained model, as in qgs eval; repeatable; default: three."),
]
Train: TypeAlias = Annotated[
    bool, typer.Option("--train", help="Train and compare recipes instead, the tiny two.")
]
Seconds: TypeAlias = Annotated[
    float | None, typer.Option(min=1, help="With --train: time of each recipe; default 120.")
]
Seed: TypeAlias = Annotated[
    int | None, typer.Option(min=0, help="With --train: seed of every recipe; default 0.")
]
Only: TypeAlias = Annotated[
    list[FigureName] | None, typer.Option(help="Draw this figure; repeatable.")
]
