"""`qgs export` and `qgs convert`: checkpoints and Gaussians, written in another form."""

from pathlib import Path
from typing import Annotated

import typer

from qgs.cli.options import Checkpoint


def export(
    checkpoint: Checkpoint,
    out: Annotated[Path, typer.Option(help="New .safetensors file; never overwritten.")],
    half: Annotated[
        bool, typer.Option("--half", help="Store half precision; loading gives float32.")
    ] = False,
) -> None:
    """Write a checkpoint as one new file, with --half at half the size."""
    from qgs.io.checkpoint import export_checkpoint

    export_checkpoint(checkpoint, out, half)
    typer.echo(f"wrote {out}: {out.stat().st_size / 1e6:.1f} MB")


def convert(
    source: Annotated[
        Path, typer.Argument(metavar="IN", help="PLY of qgs or of any 3DGS program.")
    ],
    out: Annotated[
        Path,
        typer.Argument(
            metavar="OUT", help="New file, never overwritten: .ply, .splat or a plugin's format."
        ),
    ],
    count: Annotated[
        int | None, typer.Option(min=1, help="Keep this many, the most opaque; default: all.")
    ] = None,
) -> None:
    """Write Gaussians as PLY, .splat or in a plugin's format, with --count the most opaque ones."""
    from qgs.io.files import refuse_existing
    from qgs.io.gaussians import load_ply, save_gaussians

    refuse_existing(out)
    gaussians = load_ply(source)
    kept = gaussians if count is None else gaussians.most_opaque(count)
    save_gaussians(kept, out)
    size = f"{out.stat().st_size / 1e6:.2f} MB"
    typer.echo(f"wrote {out}: {kept.count:,} of {gaussians.count:,} Gaussians, {size}")
