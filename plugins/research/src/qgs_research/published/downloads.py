"""Checkpoints at URLs: downloaded once, within limits of size and time, and kept."""

import errno
import hashlib
import os
import shutil
import string
import sys
import time
from base64 import b64encode
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath
from queue import Empty, Queue
from threading import Thread
from typing import Any, TypeAlias
from urllib.error import HTTPError
from urllib.parse import quote, unquote, urlsplit
from urllib.request import Request, urlopen

from safetensors import SafetensorError, safe_open

from qgs.files import is_leftover, replacing
from qgs.machine import with_unit
from qgs.paths import opened_path
from qgs.terminal import without_secrets

LARGEST = 20 * 10**9
"""Bytes of a download; less where the server announces less."""
WATCHED, SLOWEST = 5.0, 10_000
"""Every WATCHED seconds a download of less than SLOWEST bytes a second is reported."""
PATIENCE = 60.0
"""Seconds after which one that is always so slow ends."""

_FIXES = {401: "it needs a login", 403: "it needs a login", 404: "check the URL"}
Part: TypeAlias = tuple[int, bytes]
"""How many bytes the server announces in all, 0 for none, and some of them."""


def checkpoint(url: str) -> Path:
    """The file of `url`, as downloaded before or now; its SHA-256 is printed to standard error.

    Only whole safetensors files are kept, in the environment's QGS_CACHE or ~/.cache/qgs; one that
    has changed there is downloaded again. Raises OSError with the cause of a failure.
    """
    cache = Path(os.environ.get("QGS_CACHE") or "~/.cache/qgs").expanduser()
    key = hashlib.sha256(url.encode()).hexdigest()[:16]
    name = without_secrets(url)
    try:
        last = PurePosixPath(urlsplit(url).path).name
    except ValueError as error:
        raise OSError(f"{name} is no URL: {error}") from None
    file = cache / key / (last.strip(".")[-50:] or "checkpoint")  # a name may have 255 bytes
    written = file.with_name(f"{file.name}.sha256")
    for leftover in filter(is_leftover, cache.glob("*/.*.tmp")):
        if time.time() - leftover.stat().st_mtime > PATIENCE:  # else it may go on
            leftover.unlink(missing_ok=True)
    kept = "not downloaded again (delete the file to do so); it was kept as"
    digest = _digest(file) if file.is_file() else ""
    if digest and not _is_whole(file, digest, written):
        print(f"{file} is damaged and is downloaded again", file=sys.stderr)
        file.unlink()
        digest = ""
    if not digest:
        _download(url, file)
        written.write_text(digest := _digest(file), encoding="utf-8")
        kept = "kept as"
    print(f"{name}: sha256 {digest}, {kept} {file}", file=sys.stderr)
    return file


def _is_whole(file: Path, digest: str, written: Path) -> bool:
    """Whether `file` is safetensors, and its digest the one in `written`, if there is one."""
    try:
        with safe_open(file, "pt"):  # its header holds the size
            return not written.is_file() or written.read_bytes() == digest.encode()
    except SafetensorError:
        return False


def _digest(file: Path) -> str:
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _download(url: str, file: Path) -> None:
    name = without_secrets(url)
    try:
        with replacing(file) as temporary:
            _copy(url, temporary)
            with safe_open(temporary, "pt"):
                pass
    except Exception as error:  # whatever the file system of the URL raises
        with suppress(OSError):  # it holds something
            file.parent.rmdir()
        cause = str(getattr(error, "reason", error)) or type(error).__name__
        if isinstance(error, HTTPError):
            fix = _FIXES.get(error.code, "try again later")
            cause = f"the server answers {error.code} ({error.reason}), {fix}"
        elif isinstance(error, FileNotFoundError):
            cause = "there is no such file"
        elif isinstance(error, SafetensorError):
            cause = f"this is not a whole safetensors file ({error})"
        # the error that it comes from may hold a password
        cause = without_secrets(cause)
        raise OSError(f"{name} could not be downloaded, nothing was kept: {cause}") from None


def _copy(url: str, file: Path) -> None:
    """Write what is at `url` to `file`. Raises OSError for no checkpoint, and one too large."""
    done, announced, start = 0, 0, b""
    with file.open("wb", buffering=0) as local:  # each part sets the time of the file
        for announced, part in _arriving(url):
            done, start = done + len(part), (start + part)[:9]
            if max(done, announced) > (limit := min(LARGEST, announced or LARGEST)):
                raise OSError(f"it is larger than {with_unit(limit)}")
            if announced - done > shutil.disk_usage(file.parent).free:
                raise OSError(errno.ENOSPC, f"of {with_unit(announced)}")
            if len(start) == 9 and start[8:] != b"{":  # where the header of safetensors begins
                is_page = start.lstrip().startswith(b"<")
                what = "a web page: use the URL of the file, or log in" if is_page else "other data"
                raise OSError(f"what the server sends is no safetensors file but {what}")
            local.write(part)
    if done < announced:
        raise OSError(f"the connection ended after {with_unit(done)} of {with_unit(announced)}")


def _arriving(url: str) -> Iterator[Part]:
    """What comes from `url`; waiting is reported. Raises TimeoutError, and what opening raises."""
    parts: Queue[Part | Exception] = Queue(8)
    Thread(target=_read, args=(url, parts), daemon=True).start()
    slow, arrived, until = 0.0, 0, time.monotonic() + WATCHED
    while True:
        with suppress(Empty):
            part = parts.get(timeout=max(until - time.monotonic(), 0))
            if isinstance(part, Exception):
                raise part
            if not part[1]:
                return
            arrived += len(part[1])
            yield part
        if time.monotonic() < until:
            continue
        slow = slow + WATCHED if arrived < SLOWEST * WATCHED else 0
        rate = f"the server sent {with_unit(arrived)} in {WATCHED:g} s"
        if slow >= PATIENCE:
            raise TimeoutError(f"for {slow:g} s it was too slow, and {rate}")
        if slow:
            left = f"ends in {PATIENCE - slow:g} s if that goes on"
            print(f"{without_secrets(url)}: {rate}; the download {left}", file=sys.stderr)
        arrived, until = 0, time.monotonic() + WATCHED


def _read(url: str, parts: "Queue[Part | Exception]") -> None:
    """Put what is at `url` into `parts`, then an empty part or the error."""
    try:
        with _opened(url) as (read, announced):
            while part := read(2**16):
                parts.put((announced, part))
        parts.put((0, b""))
    except Exception as error:  # raised by whoever reads `parts`
        parts.put(error)


@contextmanager
def _opened(url: str) -> Iterator[tuple[Callable[[int], bytes], int]]:
    """What reads from `url`, and how many bytes are announced, 0 for none."""
    place = urlsplit(url)
    if place.scheme not in ("http", "https"):
        path = opened_path(url)
        store: Any = path.fs
        with store.open(path.path, "rb", block_size=2**20) as stream:
            yield stream.read, getattr(stream, "size", None) or 0
        return
    whole = place._replace(netloc=place.netloc.rpartition("@")[2]).geturl()
    request = Request(quote(whole, safe=string.punctuation))  # such as é
    if place.username:
        user = f"{unquote(place.username)}:{unquote(place.password or '')}".encode()
        request.add_unredirected_header("Authorization", f"Basic {b64encode(user).decode()}")
    with urlopen(request, timeout=2 * PATIENCE) as answer:  # long after `_arriving` gave up
        yield answer.read1, answer.length or 0
