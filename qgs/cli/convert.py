"""`qgs convert`: write Gaussians in another file format."""

from pathlib import Path
from typing import Annotated

import typer


def convert(
    source: Annotated[Path, typer.Argument(metavar="IN", help="File of Gaussians.")],
    out: Annotated[
        Path,
        typer.Argument(
            metavar="OUT", help="New file, whose suffix names the format. Must not exist yet."
        ),
    ],
    count: Annotated[
        int | None,
        typer.Option(min=1, help="Number of Gaussians to keep: the most opaque. Default: all."),
    ] = None,
) -> None:
    """Convert a file of Gaussians to another format: .ply, .compressed.ply, .spz, .splat or .glb.

    --count keeps only the most opaque Gaussians.
    """
    from qgs.files import refuse_existing
    from qgs.reconstruction.scene_formats import load_ply, save_gaussians

    # Before the file is read, which may take a while.
    refuse_existing(out)
    gaussians = load_ply(source)
    kept = gaussians if count is None else gaussians.most_opaque(count)
    save_gaussians(kept, out)
    typer.echo(f"wrote {out}: {kept.count:,} of {gaussians.count:,} Gaussians")
