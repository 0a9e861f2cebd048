"""Files and folders that appear whole or not at all; files of JSON records."""

import errno
import json
import logging
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from qgs.memory import in_words

_FULL = (errno.ENOSPC, errno.EDQUOT)

_log = logging.getLogger(__name__)


class DiskFullError(OSError):
    """There is no space for a file; the message names it, and what to do."""


@contextmanager
def replacing(path: str | os.PathLike[str], needed: str = "") -> Iterator[Path]:
    """A temporary path beside `path` that takes its place when the block ends well.

    Makes missing parent folders; the file gets the usual permissions whatever wrote it. When the
    block raises, `path` stays as it was. The new file is on the disk before it takes the place of
    the old one, and its name when the block has ended. needed: see `told_where_full`.
    """
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = target.with_name(f".{target.name}.{os.getpid()}.tmp")
    with told_where_full(target, needed):
        try:
            temporary.touch()
            mode = temporary.stat().st_mode
            yield temporary
            temporary.chmod(mode)
            _synchronise(temporary)
            os.replace(temporary, target)
            _synchronise(target.parent)
        finally:
            temporary.unlink(missing_ok=True)


@contextmanager
def told_where_full(path: Path, needed: str = "") -> Iterator[None]:
    """Raise DiskFullError about `path` when the disk is full in the `with` block.

    needed: a sentence about the space that it takes.
    """
    try:
        yield
    except OSError as error:
        if error.errno not in _FULL:
            if error.filename is None:
                error.add_note(f"while {path} was written")
            raise
        free = shutil.disk_usage(path.parent).free
        raise DiskFullError(
            f"{path} could not be written ({error.strerror}).{needed} {in_words(free)} are free "
            "there. What was saved before is whole: free space and repeat the command; a training "
            "goes on with --resume"
        ) from error


def is_leftover(path: Path) -> bool:
    """Whether `path` is a file that a process killed inside `replacing` left, or is now writing.

    safetensors, too, writes to a name of its own (.tmpXXXXXX) first.
    """
    name = r"\..+\.\d+\.tmp|\.tmp[A-Za-z0-9]{6}"
    return bool(re.fullmatch(name, path.name)) and path.is_file()


def _synchronise(path: Path) -> None:
    """Wait until `path`, a file or a folder, is on the disk."""
    number = os.open(path, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)


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


@contextmanager
def new_folder(folder: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary folder that becomes `folder` when the block ends well.

    Makes missing parent folders. Raises FileExistsError if there is anything at `folder`, also
    when it appeared while the block ran. When the block raises, there is no `folder`.
    """
    target = Path(folder)
    refuse_existing(target)
    target.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix=f".{target.name}.", dir=target.parent) as temporary:
        fresh = Path(temporary, target.name)
        fresh.mkdir()
        yield fresh
        refuse_existing(target)
        fresh.rename(target)


def refuse_existing(target: Path) -> None:
    """Raise FileExistsError for a path at which something lies already."""
    if target.exists() or target.is_symlink():
        raise FileExistsError(f"{target} exists and is never overwritten; choose another name")


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write `text` as UTF-8 to `path`, whole or not at all."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def read_records(path: Path) -> list[dict[str, Any]]:
    """The records of `path` that tell their "step"; none when the file does not exist.

    A line that is no such record is left out with a warning; a last line without an end is what a
    killed process leaves, and is left out too.
    """
    if not path.is_file():
        return []
    *lines, _ = path.read_text(encoding="utf-8", errors="replace").split("\n")
    records = []
    for number, line in enumerate(lines, start=1):
        try:
            record = json.loads(line)
            if not isinstance(record["step"], int):
                raise TypeError
            records.append(record)
        except (ValueError, TypeError, KeyError, RecursionError):
            _log.warning("%s, line %d is damaged and left out: %.80r", path, number, line)
    return records
