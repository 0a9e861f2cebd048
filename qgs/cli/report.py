"""`qgs report`: the report page of any trained models."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from qgs.cli.demo import new_folder, show_trained
from qgs.cli.options import Device, Photos, Runs


def report(
    runs: Runs,
    photos: Photos = None,
    out: Annotated[
        Path | None, typer.Option(help="New folder for the page; default: report, report-2, ...")
    ] = None,
    device: Device = "auto",
) -> None:
    """Judge trained models side by side and picture what they make; writes report.html."""
    show_trained(runs, photos, new_folder(out, "report"), Console(), device)
