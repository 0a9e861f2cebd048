"""Files appear whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary path beside `path` that takes its place when the block ends well.

    Makes missing parent folders; the file gets the usual permissions whatever wrote it. When the
    block raises, `path` stays as it was.
    """
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = target.with_name(f".{target.name}.{os.getpid()}.tmp")
    try:
        temporary.touch()
        mode = temporary.stat().st_mode
        yield temporary
        temporary.chmod(mode)
        os.replace(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def replacing_entries(folder: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary folder whose entries move into `folder` when the block ends well.

    An entry takes the place of all that was under its name, folders included; what else `folder`
    holds stays. When the block raises, `folder` stays as it was.
    """
    target = Path(folder)
    target.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix=f".{target.name}.", dir=target.parent) as temporary:
        fresh, old = Path(temporary, "fresh"), Path(temporary, "old")
        fresh.mkdir()
        old.mkdir()
        yield fresh
        target.mkdir(exist_ok=True)
        for entry in sorted(fresh.iterdir()):
            place = target / entry.name
            if place.exists():
                place.rename(old / entry.name)
            entry.rename(place)


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write `text` as UTF-8 to `path`, whole or not at all."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
