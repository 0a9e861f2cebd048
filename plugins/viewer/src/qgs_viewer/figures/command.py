"""`qgs figures`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from qgs.cli.options import Device
from qgs_viewer.options import Photos, Runs

NAMES = (
    "global_gaussians", "novel_views", "anchors", "refinement", "cross_attention",
    "self_attention", "dispersion", "curves",
)  # fmt: skip
"""Of the figures, in their order; here so that help waits for no drawing."""

app = typer.Typer(help="Figures for a paper.")


@app.command()
def figures(
    runs: Runs,
    photos: Photos = None,
    scene: Annotated[
        str | None, typer.Option(help="Scene of the figures of one scene; default: the first.")
    ] = None,
    query: Annotated[
        int | None,
        typer.Option(min=0, help="Query of the figures of one query; default: a notable one."),
    ] = None,
    only: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help=f"Make this figure: {', '.join(NAMES)}; repeatable."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="New folder; default: figures, figures-2, ...")
    ] = None,
    device: Device = "auto",
) -> None:
    """Figures of trained models for a paper, as PDF and PNG.

    Models stand side by side; figures.md explains each figure.
    """
    from qgs.train.distributed import choose_device
    from qgs_viewer.demo import new_folder
    from qgs_viewer.figures.gallery import open_exhibition, refuse_unknown, write_all

    refuse_unknown(only or ())
    folder, console = new_folder(out, "figures"), Console()
    show = open_exhibition(runs, photos, scene, query, choose_device(device))
    for sentence in show.notes:
        console.print(sentence, soft_wrap=True, highlight=False, markup=False)
    for line in write_all(show, folder, only or ()):
        console.print(line, soft_wrap=True, highlight=False, markup=False)
