"""`qgs export`: a checkpoint as one new file."""

import os
from pathlib import Path
from typing import Annotated

import typer

from qgs.checkpoint.model_file import CheckpointFile, refuse_nonfinite, write_checkpoint
from qgs.checkpoint.tensors import CheckpointError, nonfinite
from qgs.cli.options import Checkpoint
from qgs.files import refuse_existing
from qgs.wording import listed

app = typer.Typer(help="Checkpoints, written anew.")


@app.command()
def export(
    checkpoint: Checkpoint,
    out: Annotated[Path, typer.Option(help="New .safetensors file; never overwritten.")],
    half: Annotated[
        bool, typer.Option("--half", help="Store half precision; loading gives float32.")
    ] = False,
) -> None:
    """Write a checkpoint as one new file, with --half at half the size."""
    export_checkpoint(checkpoint, out, half)
    typer.echo(f"wrote {out}: {out.stat().st_size / 1e6:.1f} MB")


def export_checkpoint(name: str | os.PathLike[str], out: str | Path, half: bool = False) -> None:
    """Write a checkpoint again. half: its real numbers as float16; all else stays as it is.

    Raises as `CheckpointFile`, and CheckpointError where float16 cannot hold a weight.
    """
    out = new_checkpoint_path(out)
    with CheckpointFile(name) as file:
        tensors = file.tensors
        refuse_nonfinite(tensors, file.path)
        if half:
            tensors = {n: t.half() if t.is_floating_point() else t for n, t in tensors.items()}
        if broken := nonfinite(tensors.items()):
            raise CheckpointError(
                f"{file.path} has weights that float16 cannot hold (larger than 65504): "
                f"{listed(broken)}; ship it as it is"
            )
        write_checkpoint(out, tensors, file.recipe.tree, file.recipe.releases, file.extra)


def new_checkpoint_path(path: str | Path) -> Path:
    """`path`; raises ValueError for another suffix, FileExistsError where something lies."""
    path = Path(path)
    if path.suffix.lower() != ".safetensors":
        raise ValueError(f"{path}: weights are written as safetensors; name it .safetensors")
    refuse_existing(path)
    return path
