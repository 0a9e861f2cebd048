"""`qgs convert`: a file of Gaussians for another viewer, or of fewer Gaussians."""

from pathlib import Path
from typing import Annotated

import typer


def convert(
    source: Annotated[
        Path, typer.Argument(metavar="IN", help="PLY of qgs or of any 3DGS program.")
    ],
    out: Annotated[
        Path, typer.Argument(metavar="OUT", help="New file, .ply or .splat; never overwritten.")
    ],
    count: Annotated[
        int | None, typer.Option(min=1, help="Keep so many, the most opaque; default: all.")
    ] = None,
) -> None:
    """Write Gaussians as PLY or .splat for other viewers, the most opaque alone where asked."""
    from qgs.io.files import refuse_existing
    from qgs.io.ply import load_ply, save_ply
    from qgs.io.splat import save_splat

    writers = {".ply": save_ply, ".splat": save_splat}
    if (suffix := out.suffix.lower()) not in writers:
        raise ValueError(
            f"{out} must end in .ply or .splat; for .spz, .sog and others give the PLY to "
            "PlayCanvas' converter: `npx @playcanvas/splat-transform IN.ply OUT.sog`"
        )
    refuse_existing(out)
    gaussians = load_ply(source)
    kept = gaussians if count is None else gaussians.most_opaque(count)
    writers[suffix](kept, out)
    size = f"{out.stat().st_size / 1e6:.2f} MB"
    typer.echo(f"wrote {out}: {kept.count:,} of {gaussians.count:,} Gaussians, {size}")
