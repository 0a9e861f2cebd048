"""Local paths, fsspec URLs, and zip archives read in place as folders."""

from __future__ import annotations

import io
import json
import logging
import time
import zipfile
import zlib
from collections.abc import Callable, Iterator
from concurrent.futures import Future, wait
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path, PurePosixPath
from threading import Thread
from typing import IO, Any, Literal, TypeVar

from upath import UPath

from qgs.memory import in_words

PAUSES = (1.0, 4.0, 15.0, 60.0)
"""Seconds before a remote store that failed is asked again."""

PATIENCE = 300.0
"""Seconds in which a remote store must answer: it may list a million files, or send a PART."""

PART = 32_000_000
"""Bytes that a remote store is asked for at a time."""

LARGEST = 500_000_000
"""Bytes of a file that is read as a whole, such as an uncompressed photo of 120 million pixels; a
small archive may promise any number."""

_LARGEST_JSON = 50_000_000  # which may take forty times as much once parsed

Answer = TypeVar("Answer")
_log = logging.getLogger(__name__)
_NO_FAULT_OF_A_STORE = (
    FileNotFoundError, IsADirectoryError, NotADirectoryError, PermissionError, zipfile.BadZipFile,
    zlib.error, EOFError, MemoryError, ImportError, ValueError, TypeError, RuntimeError,
)  # fmt: skip

_PROTOCOLS = {  # the packages that file systems of fsspec need: the protocols that they serve
    "requests aiohttp": ("http", "https"),
    "s3fs": ("s3", "s3a"),
    "gcsfs": ("gs", "gcs"),
    "adlfs": ("az", "abfs", "abfss"),
    '"query-gaussians[hub]"': ("hf",),
    "paramiko": ("sftp", "ssh"),
    "smbprotocol": ("smb",),
    "webdav4": ("webdav",),
}


def opened_path(path: str | Path | UPath) -> UPath:
    """`path`, a URL or local, as a UPath. Raises ValueError for an unusable file system."""
    try:
        url = UPath(path)
        url.fs  # noqa: B018  asks for the file system, whose package may be missing
    except ImportError as error:
        protocol = str(path).partition(":")[0]
        packages = [needed for needed, served in _PROTOCOLS.items() if protocol in served]
        remedy = f": pip install {packages[0]}" if packages else ""
        raise ValueError(f"{path} cannot be opened: {error}{remedy}") from error
    except ValueError as error:
        raise ValueError(f"{path} cannot be opened as a path or URL: {error}") from error
    if url.protocol in {"file", "local"}:
        return UPath(url.path)
    return url.expanduser() if is_local(url) else url


def is_local(path: Path | UPath) -> bool:
    """Whether the system can open `path` by its name, as torch and zipfile do."""
    return isinstance(path, Path)


class StoreError(OSError):
    """A remote store that failed again and again; the message names the URL."""


def asked_again(path: Path | UPath, action: Callable[[], Answer]) -> Answer:
    """What `action` gives, which reads `path`; of a remote store, asked again after PAUSES.

    An `action` that takes longer than PATIENCE has failed. Raises as `action`, what is absent,
    forbidden or damaged at once; StoreError after the last pause.
    """
    if is_local(path) or isinstance(path, ArchivePath):
        return action()
    for pause in (*PAUSES, None):
        try:
            return _in_time(action)
        except _NO_FAULT_OF_A_STORE:
            raise
        except Exception as error:  # each file system raises its own
            said = str(error) or type(error).__name__
            if pause is None:
                raise StoreError(
                    f"{path} cannot be read: its store failed {len(PAUSES) + 1} times in a row, at "
                    f"last with: {said}. See that it can be reached, then repeat the command"
                ) from error
            _log.warning("%s: %s; the store is asked again in %g s", path, said, pause)
            time.sleep(pause)
    raise AssertionError


def _in_time(action: Callable[[], Answer]) -> Answer:
    """What `action` gives, in a thread that is left alone after PATIENCE. Raises TimeoutError."""
    answer: Future[Answer] = Future()

    def ask() -> None:
        try:
            answer.set_result(action())
        except BaseException as error:  # raised by `result`
            answer.set_exception(error)

    Thread(target=ask, name="qgs-store", daemon=True).start()
    if not wait([answer], PATIENCE).done:
        raise TimeoutError(f"no answer in {PATIENCE:g} s")
    return answer.result()


def listing(folder: UPath) -> list[UPath]:
    """What `folder` holds; nothing where it is no folder. Raises as `asked_again`."""
    try:
        return asked_again(folder, lambda: list(folder.iterdir()))
    except (FileNotFoundError, NotADirectoryError):
        return []


def open_file(path: Path | UPath, most: int = LARGEST) -> IO[bytes]:
    """`path`, open for reading bytes; a remote one is read whole, see `asked_again`.

    Raises OSError, also for a pipe, a device or a folder, and a remote one beyond `most` bytes.
    """
    if isinstance(path, ArchivePath):
        return io.BytesIO(open_archive(path.archive).read(path.member, most))
    if not isinstance(path, Path):
        return io.BytesIO(_no_more(_fetched(path, most + 1), path, most))
    if path.exists() and not path.is_file():
        raise OSError("it is no regular file, but a folder, a pipe or a device")
    return path.open("rb")


def _fetched(path: UPath, most: int) -> bytes:
    """The first `most` bytes of a remote file. What of it did not come is asked for again."""
    store: Any = path.fs
    content: bytes = asked_again(path, lambda: store.cat_file(path.path, 0, min(PART, most)))
    size: int | None = asked_again(path, lambda: store.info(path.path).get("size"))
    if size is None:  # some servers do not tell; one that stops early is then not noticed
        if len(content) == PART:
            content += asked_again(path, lambda: store.cat_file(path.path, PART, most))
        return content
    while (first := len(content)) < (end := min(size, most)):
        content += asked_again(path, lambda a=first, b=end: _some(store, path, a, min(a + PART, b)))
    return content


def _some(store: Any, path: UPath, first: int, end: int) -> bytes:
    part: bytes = store.cat_file(path.path, first, end)
    if not 0 < len(part) <= end - first:
        raise OSError(f"{len(part):,} bytes came of those from {first:,} to {end:,}")
    return part


def read_file(path: Path | UPath, most: int = LARGEST) -> bytes:
    """The bytes of `path`. Raises as `open_file`, and OSError for more than `most`."""
    with open_file(path, most) as file:
        if is_local(path):
            _refuse_larger(path, path.stat().st_size, most)
        return _no_more(file.read(most + 1), path, most)


def _no_more(content: bytes, path: object, most: int) -> bytes:
    _refuse_larger(path, len(content), most)
    return content


def _refuse_larger(path: object, size: int, most: int) -> None:
    if size > most:
        raise OSError(f"{path} is larger than {in_words(most)}")


def read_json(path: UPath, fix: str, **options: Any) -> Any:
    """What a JSON file holds; integers of more than 18 digits become floats, which may be infinite.

    fix: what to do, for the message. options: of `json.loads`. Raises ValueError for a file that
    is no JSON, FileNotFoundError for none.
    """
    try:
        # Python refuses more than 4300 digits, and NumPy more than 18 among floats
        number = lambda digits: int(digits) if len(digits) <= 18 else float(digits)  # noqa: E731
        return json.loads(read_file(path, _LARGEST_JSON), parse_int=number, **options)
    except (FileNotFoundError, StoreError):
        raise
    except RecursionError:
        reason = "its brackets are nested too deeply"
    except (ValueError, OSError) as error:
        reason = str(error).replace(f"{path} is", "it is")
    raise ValueError(f"{path} is not valid JSON ({reason}): {fix}")


def stays_inside(name: str) -> bool:
    """Whether a relative name, of either kind of slash, leads nowhere above where it starts."""
    parts = PurePosixPath(name.replace("\\", "/")).parts
    return bool(parts) and parts[0] != "/" and ".." not in parts and ":" not in parts[0]


class Archive:
    """An open zip file: `files` by path to its names, `folders` to names in them. ValueError."""

    def __init__(self, path: UPath) -> None:
        try:
            self._path, self._zip = path, asked_again(path, lambda: _opened_zip(path))
        except (zipfile.BadZipFile, zlib.error) as error:
            raise ValueError(
                f"{path} is no zip archive or is cut off ({error}): download it again"
            ) from error
        self.files: dict[str, str] = {}
        self.folders: dict[str, set[str]] = {"": set()}
        for name in self._zip.namelist():
            parts = PurePosixPath(name.replace("\\", "/")).parts
            if parts and not stays_inside(name):
                raise ValueError(
                    f"{path} holds the name {name!r}, which leads outside the archive: it is not "
                    "read. Get the archive from its publisher again"
                )
            for depth, part in enumerate(parts):
                self.folders.setdefault("/".join(parts[:depth]), set()).add(part)
            if name.endswith(("/", "\\")):
                self.folders.setdefault("/".join(parts), set())
            elif parts:
                self.files["/".join(parts)] = name

    def read(self, member: str, most: int = LARGEST) -> bytes:
        """The bytes of a file. Raises OSError for one that is absent, damaged or beyond `most`."""
        try:
            info = self._zip.getinfo(self.files[member])
            _refuse_larger(f"{self._path}/{member}", info.file_size, most)
            return asked_again(self._path, lambda: self._zip.read(info))
        except KeyError as error:
            raise FileNotFoundError(f"the archive has no file {member}") from error
        except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError) as error:
            raise OSError(f"the archive is damaged there: {error}") from error


def _opened_zip(path: UPath) -> zipfile.ZipFile:
    return zipfile.ZipFile(str(path) if is_local(path) else path.open("rb"))


open_archive = lru_cache(maxsize=8)(Archive)
"""A process keeps the last archives open."""


@dataclass(frozen=True)
class ArchivePath:
    """A member of a zip archive, "" for its top, with the part of pathlib's interface used."""

    archive: UPath
    member: str = ""

    def __str__(self) -> str:
        return f"{self.archive}/{self.member}" if self.member else str(self.archive)

    def __truediv__(self, name: str) -> ArchivePath:
        return ArchivePath(self.archive, str(PurePosixPath(self.member, name)))

    @property
    def name(self) -> str:
        """Last part of the path."""
        return PurePosixPath(self.member).name or self.archive.name

    @property
    def suffix(self) -> str:
        """The name's suffix, such as .png."""
        return PurePosixPath(self.name).suffix

    @property
    def parent(self) -> ArchivePath:
        """The folder that holds it; the top holds itself."""
        folder = str(PurePosixPath(self.member).parent)
        return ArchivePath(self.archive, "" if folder == "." else folder)

    def is_file(self) -> bool:
        """Whether it is a file of the archive."""
        return self.member in open_archive(self.archive).files

    def is_dir(self) -> bool:
        """Whether it is a folder of the archive."""
        return self.member in open_archive(self.archive).folders

    def iterdir(self) -> Iterator[ArchivePath]:
        """What the folder holds, by name. Raises FileNotFoundError when it is no folder."""
        names = open_archive(self.archive).folders.get(self.member)
        if names is None:
            raise FileNotFoundError(f"{self} is no folder of the archive")
        return (self / name for name in sorted(names))

    def read_bytes(self) -> bytes:
        """The file's bytes. Raises OSError for one that is absent, damaged or beyond LARGEST."""
        return open_archive(self.archive).read(self.member)

    def open(self, mode: Literal["rb"]) -> IO[bytes]:
        """The file, open for reading bytes."""
        return io.BytesIO(self.read_bytes())
