"""Named tensors in safetensors files: written whole or not at all, read with clear errors."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from qgs.io.atomic import replacing

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class CheckpointError(ValueError):
    """A file that is no usable checkpoint; the message says why and what to do."""


def write_tensors(
    path: str | os.PathLike[str], tensors: Mapping[str, Tensor], metadata: Mapping[str, str]
) -> None:
    """Write `tensors`, on the CPU and contiguous, to `path`, whole or not at all.

    Raises OSError that tells the space needed and the space there is; what `path` held before is
    then still there.
    """
    try:
        with replacing(path) as temporary:
            save_file(dict(tensors), temporary, dict(metadata))
    except (SafetensorError, OSError) as error:
        if isinstance(error, OSError) and error.errno not in _FULL:
            raise
        needed = sum(tensor.numel() * tensor.element_size() for tensor in tensors.values())
        free = shutil.disk_usage(Path(path).parent).free
        raise OSError(
            f"{path} could not be written ({error}). It takes {needed / 1e6:.1f} MB beside the "
            f"file that it replaces, and {free / 1e6:.1f} MB are free there. What was saved before "
            "is whole: free space and save again; a training run goes on with --resume"
        ) from error


@contextmanager
def opened_tensors(path: str | os.PathLike[str]) -> Iterator[Any]:
    """The safetensors file at `path`, as `safetensors.safe_open` gives it.

    Raises CheckpointError when it is cut off or something else.
    """
    try:
        with safe_open(path, "pt") as file:
            yield file
    except SafetensorError as error:
        raise CheckpointError(
            f"{path} is not a whole safetensors file ({error}); it may be cut off: copy it again"
        ) from error
