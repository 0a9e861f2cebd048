"""Files behind fsspec URLs appear whole or not at all, as local ones do."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from upath import UPath

from qgs.data.paths import is_local
from qgs.io.atomic import replacing


@contextmanager
def opened_replacing(path: UPath) -> Iterator[IO[bytes]]:
    """A file to write, which takes the place of `path` when the block ends well.

    Makes missing parent folders. Object stores show an object when it is complete, so moving it is
    as atomic as their copying. When the block raises, `path` stays as it was.
    """
    if is_local(path):
        with replacing(Path(str(path))) as temporary, temporary.open("wb") as file:
            yield file
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as file:
            yield file
        path.fs.mv(temporary.path, path.path)
    except BaseException:
        if temporary.exists():
            temporary.unlink()
        raise


def write_bytes(path: UPath, data: bytes) -> None:
    """Write `data` to `path`, whole or not at all."""
    with opened_replacing(path) as file:
        file.write(data)
