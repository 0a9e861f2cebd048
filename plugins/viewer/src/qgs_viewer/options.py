"""Options that commands for several models share."""

from typing import Annotated, TypeAlias

import typer

Runs: TypeAlias = Annotated[
    list[str],
    typer.Argument(
        metavar="RUN...", help="Run folders, checkpoints, their URLs, or shipped models."
    ),
]
PHOTOS_HELP = "Photos and cameras; default: the recipe's data, of shipped models rooms unseen."
Photos: TypeAlias = Annotated[str | None, typer.Option(help=PHOTOS_HELP)]
