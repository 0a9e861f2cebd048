"""A checkpoint as one new file."""

import os
from pathlib import Path

from qgs.checkpoint.model_file import CheckpointFile, refuse_nonfinite, write_checkpoint
from qgs.checkpoint.tensors import CheckpointError, nonfinite
from qgs.files import refuse_existing
from qgs.wording import listed


def export_checkpoint(name: str | os.PathLike[str], out: str | Path, half: bool = False) -> None:
    """Write a checkpoint again. half: its real numbers as float16; all else stays as it is.

    Raises as `CheckpointFile`, and CheckpointError where float16 cannot hold a weight.
    """
    out = new_checkpoint_path(out)
    with CheckpointFile(name) as file:
        tensors = file.tensors
        refuse_nonfinite(tensors, file.path)
        if half:
            real = {name: t.half() for name, t in tensors.items() if t.is_floating_point()}
            tensors = {**tensors, **real}
        # Finite in float32, they may be infinite now.
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
