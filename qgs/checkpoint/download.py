"""Checkpoints at URLs: downloaded once, within a limit of size, and kept."""

import hashlib
import os
import shutil
import string
import sys
from base64 import b64encode
from pathlib import Path, PurePosixPath
from typing import IO, Any
from urllib.error import HTTPError
from urllib.parse import quote, unquote, urlsplit
from urllib.request import Request, urlopen

from safetensors import SafetensorError, safe_open

from qgs.files import replacing
from qgs.machine import with_unit
from qgs.paths import opened_path
from qgs.terminal import without_secrets

LARGEST = 20 * 10**9
"""Most bytes of a download."""
PATIENCE = 60.0
"""Seconds that a server may stay silent."""


def downloaded(url: str) -> Path:
    """Return the file of `url`, as downloaded before or now; print its SHA-256 to standard error.

    Only whole safetensors files are kept, in the environment's QGS_CACHE or ~/.cache/qgs; one that
    is damaged there is downloaded again. Raises OSError with the cause of a failure.
    """
    name = without_secrets(url)
    try:
        last = PurePosixPath(urlsplit(url).path).name
    except ValueError as error:
        raise OSError(f"{name} is no URL: {error}") from None
    cache = Path(os.environ.get("QGS_CACHE") or "~/.cache/qgs").expanduser()
    # By the whole URL: two servers may have files of one name.
    key = hashlib.sha256(url.encode()).hexdigest()[:16]
    # A file name may have 255 bytes.
    file = cache / key / (last.strip(".")[-50:] or "checkpoint")
    kept = "not downloaded again (delete the file to do so); it was kept as"
    if file.is_file() and not _is_whole(file):
        print(f"{file} is damaged and is downloaded again", file=sys.stderr)
        file.unlink()
    if not file.is_file():
        _download(url, file)
        kept = "kept as"
    with file.open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
    print(f"{name}: sha256 {digest}, {kept} {file}", file=sys.stderr)
    return file


def _is_whole(file: Path) -> bool:
    try:
        # The header of safetensors holds the size of the file.
        with safe_open(file, "pt"):
            return True
    except SafetensorError:
        return False


def _download(url: str, file: Path) -> None:
    try:
        with replacing(file) as temporary:
            with _opened(url) as stream, temporary.open("wb") as local:
                _copy(stream, local, file.parent)
            if not _is_whole(temporary):
                raise ValueError("what came is no whole safetensors file, or a web page")
    # The file system of the URL may raise anything.
    except Exception as error:
        cause = str(getattr(error, "reason", error)) or type(error).__name__
        if isinstance(error, HTTPError):
            cause = f"the server answers {error.code} ({error.reason})"
        text = f"{url} could not be downloaded, nothing was kept: {cause}"
        # `from None`: the error itself may show a password.
        raise OSError(without_secrets(text)) from None


def _copy(stream: Any, local: IO[bytes], folder: Path) -> None:
    """Copy `stream` to `local`. Raises OSError for more than LARGEST, or than fits."""
    announced = getattr(stream, "length", None) or getattr(stream, "size", None) or 0
    # A server may announce less than it sends, or nothing.
    limit = min(LARGEST, shutil.disk_usage(folder).free)
    left = limit
    while announced <= limit and left > 0 and (part := stream.read(2**20)):
        local.write(part)
        left -= len(part)
    if announced > limit or left <= 0:
        raise OSError(f"it is larger than {with_unit(limit)}")


def _opened(url: str) -> Any:
    """Open `url` for reading; a user and password in it are sent as HTTP's Basic login."""
    place = urlsplit(url)
    if place.scheme not in ("http", "https"):
        path = opened_path(url)
        return path.fs.open(path.path, "rb", block_size=2**20)
    host = place.netloc.rpartition("@")[2]
    # Letters such as é must be quoted.
    request = Request(quote(place._replace(netloc=host).geturl(), safe=string.punctuation))
    if place.username:
        login = f"{unquote(place.username)}:{unquote(place.password or '')}".encode()
        # Unredirected: the server that this one leads to must not get the password.
        request.add_unredirected_header("Authorization", f"Basic {b64encode(login).decode()}")
    return urlopen(request, timeout=PATIENCE)
