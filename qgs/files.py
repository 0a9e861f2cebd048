"""Atomic writing of files and folders, and reading of files with one JSON record on each line."""

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

from rich.filesize import decimal

from qgs.wording import listed

AnyPath = str | os.PathLike[str]
"""Path as a string or a path object."""

_FULL = (errno.ENOSPC, errno.EDQUOT)

_log = logging.getLogger(__name__)


@contextmanager
def replacing(path: AnyPath) -> Iterator[Path]:
    """Yield a temporary path in the folder of `path`; it replaces `path` when the block ends.

    If the block raises, `path` stays unchanged. Missing parent folders are made. The new file gets
    the usual permissions, and is on the disk before it replaces the old file.
    """
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    # Beside the target: only a file of the same disk can replace it at once.
    temporary = target.with_name(f".{target.name}.{os.getpid()}.tmp")
    with naming_full_disk(target):
        try:
            # A library may write with other permissions, so those of a plain file are kept.
            temporary.touch()
            mode = temporary.stat().st_mode
            yield temporary
            temporary.chmod(mode)
            # Otherwise a crash could leave the new name with old or no content.
            _synchronise(temporary)
            os.replace(temporary, target)
            # The name too must be on the disk.
            _synchronise(target.parent)
        finally:
            temporary.unlink(missing_ok=True)


@contextmanager
def naming_full_disk(path: Path) -> Iterator[None]:
    """Turn an error for lack of disk space in the block into an OSError with `path` and advice."""
    try:
        yield
    except OSError as error:
        if error.errno not in _FULL:
            raise
        free = shutil.disk_usage(path.parent).free
        raise OSError(
            f"{path} could not be written ({error.strerror}): only {decimal(free)} of disk space "
            "are left. Please free space and repeat the command; continue a training with "
            "--resume. Earlier files are undamaged"
        ) from error


def is_leftover(path: Path) -> bool:
    """Return whether `path` is a temporary file of `replacing` or of safetensors (.tmpXXXXXX)."""
    name = r"\..+\.\d+\.tmp|\.tmp[A-Za-z0-9]{6}"
    return bool(re.fullmatch(name, path.name)) and path.is_file()


def _synchronise(path: Path) -> None:
    """Wait until the file or folder `path` is written to disk."""
    number = os.open(path, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)


@contextmanager
def replacing_entries(folder: AnyPath, mark: str) -> Iterator[Path]:
    """Yield a temporary folder; its entries move into `folder` when the block ends.

    An entry replaces the file or folder of the same name; all other entries of `folder` stay. If
    the block raises, `folder` stays unchanged.
    mark: name of an entry by which an earlier result is recognised. Raises FileExistsError if an
        entry would be replaced and `folder` has no entry `mark`.
    """
    target = Path(folder)
    target.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix=f".{target.name}.", dir=target.parent) as temporary:
        fresh = Path(temporary, "fresh")
        old = Path(temporary, "old")
        fresh.mkdir()
        old.mkdir()
        yield fresh
        target.mkdir(exist_ok=True)
        names = sorted(entry.name for entry in fresh.iterdir())
        there = [name for name in names if (target / name).exists()]
        if there and mark not in there:
            raise FileExistsError(
                f"{target} holds {listed(there)}, but no earlier result to replace: choose "
                "another folder"
            )
        try:
            for name in names:
                if name in there:
                    (target / name).rename(old / name)
                (fresh / name).rename(target / name)
        # Ctrl-C too must leave an earlier result as it was.
        except BaseException:
            # What was moved aside comes back, so that a failure changes nothing.
            for entry in old.iterdir():
                if (target / entry.name).exists():
                    (target / entry.name).rename(fresh / entry.name)
                entry.rename(target / entry.name)
            raise


def refuse_existing(target: Path) -> None:
    """Raise FileExistsError if `target` exists, even as a broken link."""
    if os.path.lexists(target):
        raise FileExistsError(f"{target} exists and is never overwritten; choose another name")


def refuse_filled(out: Path, advice: str = "delete it yourself") -> None:
    """Raise FileExistsError if `out` is a file, or a folder that is not empty.

    advice: what a user can do instead of choosing another name; it ends the message.
    """
    if out.is_file() or (out.is_dir() and any(out.iterdir())):
        raise FileExistsError(
            f"{out} is a file or a folder that is not empty: choose another --out, or {advice}"
        )


def write_text(path: AnyPath, text: str) -> None:
    """Write `text` as UTF-8 to `path`; if this fails, `path` stays unchanged."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def read_records(path: Path) -> list[dict[str, Any]]:
    """Read JSON records with a "step", one on each line; none if `path` does not exist.

    Damaged lines are skipped with a warning. An unfinished last line, which a killed process
    leaves, is skipped without a warning.
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
