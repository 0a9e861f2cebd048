"""`qgs import` and `qgs export`."""

from pathlib import Path
from typing import Annotated

import typer

from qgs.cli.options import Checkpoint, Overrides

app = typer.Typer(help="Published weights in, checkpoints out.")
export_app = typer.Typer(help="Checkpoints, written anew.")


@app.command()
def import_(
    weights: Annotated[
        Path, typer.Argument(help="Published weights: .safetensors, or .pt .pth .bin .ckpt.")
    ],
    recipe: Annotated[
        str, typer.Option(help="Recipe file whose model they are; auto for the one that fits.")
    ],
    out: Annotated[Path, typer.Option(help="New checkpoint; never overwritten.")],
    overrides: Overrides = None,
) -> None:
    """Turn published weights into a checkpoint; every tensor is accounted for.

    With `--recipe auto` the recipe that fits, after every --set, is written beside the checkpoint,
    as .yaml. A recipe without data knows no image size: give `--set data.type=qgs/photos --set
    data.path=PHOTOS --set data.image_size=[256,256]`, or `qgs reconstruct --size`.
    """
    from qgs.recipe import resolve
    from qgs_research.published.importing import import_weights

    resolved = None if recipe == "auto" else resolve(recipe, overrides or ())
    done = import_weights(weights, resolved, out, overrides=overrides or ())
    typer.echo("\n".join(done.report))


@export_app.command()
def export(
    checkpoint: Checkpoint,
    out: Annotated[Path, typer.Option(help="New .safetensors file; never overwritten.")],
    half: Annotated[
        bool, typer.Option("--half", help="Store half precision; loading gives float32.")
    ] = False,
) -> None:
    """Write a checkpoint as one new file, with --half at half the size."""
    from qgs_research.published.importing import export_checkpoint

    export_checkpoint(checkpoint, out, half)
    typer.echo(f"wrote {out}: {out.stat().st_size / 1e6:.1f} MB")
