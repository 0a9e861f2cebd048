"""Commands `qgs import` and `qgs export`."""

from pathlib import Path
from typing import Annotated

import typer

from qgs.cli.options import Checkpoint, Overrides

app = typer.Typer(help="Turn published weights into checkpoints.")
export_app = typer.Typer(help="Copy checkpoints, also in half precision.")


@app.command()
def import_(
    weights: Annotated[
        Path, typer.Argument(help="Published weights: .safetensors, or .pt .pth .bin .ckpt.")
    ],
    recipe: Annotated[
        str, typer.Option(help="Recipe of the model. auto derives it from the weights.")
    ],
    out: Annotated[Path, typer.Option(help="New file for the checkpoint; must not exist.")],
    overrides: Overrides = None,
) -> None:
    """Turn published weights into a checkpoint. An unknown tensor is an error.

    `--recipe auto` also writes the derived recipe, with all options of --set, to a .yaml file
    beside the checkpoint. A recipe without data has no image size: give `--set data.type=qgs/photos
    --set data.path=PHOTOS --set data.image_size=[256,256]`, or later give `qgs reconstruct --size`.
    """
    from qgs.recipe import resolve
    from qgs_research.published.importing import import_weights

    resolved = None if recipe == "auto" else resolve(recipe, overrides or ())
    report = import_weights(weights, resolved, out, overrides=overrides or ())
    typer.echo("\n".join(report))


@export_app.command()
def export(
    checkpoint: Checkpoint,
    out: Annotated[Path, typer.Option(help="New .safetensors file; must not exist.")],
    half: Annotated[
        bool, typer.Option("--half", help="Store float16; loading converts to float32.")
    ] = False,
) -> None:
    """Copy a checkpoint to a new file. With --half, weights are float16, at half the size."""
    from qgs_research.published.importing import export_checkpoint

    export_checkpoint(checkpoint, out, half)
    typer.echo(f"wrote {out}: {out.stat().st_size / 1e6:.1f} MB")
