"""Reading of files at local paths, at fsspec URLs, and inside zip archives."""

import io
import json
import zipfile
import zlib
from pathlib import Path
from typing import IO, Any

from rich.filesize import decimal
from upath import UPath

from qgs.terminal import without_secrets

LARGEST = 500_000_000
"""Size limit in bytes of files read as a whole; an uncompressed 120-megapixel photo fits."""

# Parsed JSON may take forty times as much memory.
_LARGEST_JSON = 50_000_000
_DAMAGED = (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, NotImplementedError)


def opened_path(path: str | Path | UPath) -> UPath:
    """Return a local path or URL as a UPath; raise ValueError for an unusable file system."""
    try:
        url = UPath(path)
        # The package of a file system may be missing, and its constructor may raise anything.
        url.fs  # noqa: B018
    except Exception as error:
        what = without_secrets(f"{path} cannot be opened as a path or URL: {error}")
        raise ValueError(what) from error
    if url.protocol in {"file", "local"}:
        return UPath(url.path)
    return url.expanduser() if is_local(url) else url


def is_local(path: Path | UPath) -> bool:
    """Return whether `path` is local, so that libraries such as torch can open it by name."""
    return isinstance(path, Path)


def listing(folder: UPath) -> list[UPath]:
    """List the content of `folder`; an empty list if it is not a folder."""
    try:
        return list(folder.iterdir())
    except (FileNotFoundError, NotADirectoryError):
        return []


def open_file(path: Path | UPath) -> IO[bytes]:
    """Open `path` for reading bytes; a remote file is read as a whole first. Raises OSError."""
    if not is_local(path):
        # Decoders seek often, and each seek would be a request to the server.
        return io.BytesIO(read_file(path))
    # Reading a pipe or device may never end.
    if path.is_fifo() or path.is_char_device():
        raise OSError(f"{path} is a pipe or a device: give a regular file")
    return path.open("rb")


def read_file(path: Path | UPath, most: int = LARGEST) -> bytes:
    """Return the bytes of `path`; raise OSError for more than `most` bytes or a damaged archive."""
    # Held while it is read: a thread that uses `path` at the same moment may replace its archive,
    # which closes once nobody holds it.
    system: Any = getattr(path, "fs", None)
    try:
        with open_file(path) if is_local(path) else system.open(UPath(path).path) as file:
            # The header of an archive may promise less than it holds.
            content: bytes = file.read(most + 1)
    except _DAMAGED as error:
        raise OSError(f"{path} cannot be decoded ({error}): write or copy it again") from error
    if len(content) > most:
        raise OSError(f"{path} is larger than {decimal(most)}, the limit for files read as a whole")
    return content


def read_json(path: UPath, fix: str) -> Any:
    """Return the content of a JSON file.

    fix: advice at the end of the error message. Raises ValueError if the file is not JSON, and
    OSError as `read_file` does.
    """
    content = read_file(path, _LARGEST_JSON)
    try:
        return json.loads(content)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is not valid JSON ({error}): {fix}") from error
