"""`qgs data check`: what is wrong with a data set, one line for each fault."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from qgs.data.check.dataset import CheckReport
    from qgs.data.check.scene import SceneReport

_ROWS = 40


class Format(StrEnum):
    """Formats of data sets; auto tells them from what is there."""

    auto = "auto"
    nerfstudio = "nerfstudio"
    blender = "blender"
    colmap = "colmap"
    llff = "llff"
    chunks = "chunks"
    dl3dv = "dl3dv"


def check(
    path: Annotated[str, typer.Argument(help="Data set: a folder, an archive, a chunk, a URL.")],
    index: Annotated[
        list[str] | None,
        typer.Option(help="Evaluation index to compare with the scenes; repeatable."),
    ] = None,
    format: Annotated[
        Format, typer.Option(help="Only scenes listed in this format.")
    ] = Format.auto,
    images: Annotated[
        str | None, typer.Option(help="Folder of photos to read, such as images_4.")
    ] = None,
    report: Annotated[
        Path | None, typer.Option(help="HTML page to write, with cameras and the worst pairs.")
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Read only the headers of images, match none.")
    ] = False,
    geometry: Annotated[
        int, typer.Option(help="In how many scenes poses are judged by photos.", min=0)
    ] = 20,
    threads: Annotated[int, typer.Option(help="Threads that decode images.", min=1)] = 8,
) -> None:
    """Find what is wrong with a data set: one line for each fault, with scene, frame and remedy.

    Every image is decoded, and poses are compared with what neighbouring photos share. Exit code 1
    when there are errors, 0 when there are none or only warnings.
    """
    from rich.console import Console

    from qgs.data.check.dataset import Options, check
    from qgs.data.paths import opened_path

    console = Console()
    options = Options(geometry, quick, threads, format.value, images)
    indices = [opened_path(name) for name in index or []]
    with console.status("listing scenes") as status:
        result = check(
            opened_path(path), options, indices,
            lambda done, total, name: status.update(f"{done} of {total} scenes, now {name}"),
        )  # fmt: skip
    _print(console, result)
    if report is not None:
        from qgs.analysis.check import check_html
        from qgs.io.atomic import write_text

        write_text(report, check_html(result))
        _line(console, f"report: {report}")
    if result.errors:
        raise typer.Exit(1)


def _print(console: Console, result: CheckReport) -> None:
    if result.scenes:
        console.print(_table(result.scenes))
    hidden = len(result.scenes) - _ROWS
    if hidden > 0:
        _line(console, f"and {hidden} more scenes, none of them with more findings than these")
    for finding in result.findings:
        _line(console, str(finding))
    for summary in result.indices:
        _line(console, f"index {summary}")
    for note in result.notes:
        _line(console, f"note: {note}")
    warnings = len(result.findings) - result.errors
    counts = (
        _counted(len(result.scenes), "scene"),
        _counted(result.errors, "error"),
        _counted(warnings, "warning"),
    )
    _line(console, f"{result.path}: {', '.join(counts)}")


def _counted(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def _line(console: Console, text: str) -> None:
    console.print(text, highlight=False, markup=False, soft_wrap=True)


def _table(scenes: Sequence[SceneReport]) -> Table:
    from rich.table import Table

    table = Table(header_style="bold", box=None, pad_edge=False)
    table.add_column("scene", overflow="fold", min_width=12)
    table.add_column("format")
    for column in ("frames", "decodable", "missing", "bad poses", "epipolar px"):
        table.add_column(column, justify="right")
    shown = (
        sorted(scenes, key=lambda scene: -len(scene.findings)) if len(scenes) > _ROWS else scenes
    )
    for scene in shown[:_ROWS]:
        table.add_row(*_row(scene))
    return table


def _row(scene: SceneReport) -> list[str]:
    counts = (scene.listed, scene.decodable, scene.missing, scene.pose_problems)
    return [scene.name, scene.kind, *map(str, counts), scene.epipolar]
