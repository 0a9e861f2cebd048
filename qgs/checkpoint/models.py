"""Find checkpoints by path, by the name of a model that an installed plugin ships, or by URL.

A file at a URL is downloaded once and kept.
"""

import hashlib
import os
import shutil
import string
from base64 import b64encode
from pathlib import Path, PurePosixPath
from typing import IO, Any
from urllib.error import HTTPError
from urllib.parse import quote, unquote, urlsplit
from urllib.request import Request, urlopen

from rich.filesize import decimal
from safetensors import SafetensorError, safe_open

from qgs.files import AnyPath, replacing
from qgs.paths import opened_path
from qgs.recipe.registry import available_plugins, load_plugin
from qgs.terminal import without_secrets
from qgs.wording import did_you_mean, warn_once

CHECKPOINT = "checkpoint.safetensors"
"""Name of the checkpoint file in a run folder. It has the last weights before training diverged, or
else the latest weights."""
LARGEST = 20 * 10**9
"""Largest download, in bytes."""
PATIENCE = 60.0
"""Seconds after which a download fails if the server sends nothing."""


def checkpoint_path(name: AnyPath) -> Path:
    """Return the local file of the checkpoint `name`.

    name: path of a checkpoint file or of a run folder that contains a checkpoint; PLUGIN/NAME of a
    model that an installed plugin ships (see `qgs list`); or a URL that fsspec opens
    (see `downloaded`). If `name` is an existing path, it is read as a path. Raises
    FileNotFoundError, PluginError for a plugin that cannot be used, and OSError for a failed
    download.
    """
    text = os.fspath(name)
    path = Path(text).expanduser()
    plugin, _, model = text.partition("/")
    if path.is_dir():
        path = path / CHECKPOINT
    elif not path.exists():
        if "://" in text:
            return downloaded(text)
        # Only a plug-in that is installed makes a name of what may be a path.
        is_name = bool(model) and "/" not in model and path.suffix != ".safetensors"
        if is_name and plugin in available_plugins().names:
            installed = load_plugin(plugin)
            if text not in installed.models:
                hint = did_you_mean(text, installed.models, "models")
                raise FileNotFoundError(f"{installed.released_as} ships no model {text}; {hint}")
            path = installed.models[text]
    if not path.is_file():
        raise FileNotFoundError(
            f"no checkpoint at {path}; give a run folder of `qgs train`, a .safetensors file, its "
            "URL, or the name of a model that a plug-in ships, such as rooms/locus-64"
        )
    return path


def card_of(file: Path) -> str:
    """Return the text of a model's card, NAME.md beside NAME.safetensors; "" if it has no card."""
    card = file.with_suffix(".md")
    return card.read_text(encoding="utf-8") if card.is_file() else ""


def about(file: Path) -> str:
    """Return the first paragraph of the card of the model in `file`; "" if there is no card."""
    paragraphs = (part for part in card_of(file).split("\n\n") if not part.startswith("#"))
    return " ".join(next(paragraphs, "").split())


def downloaded(url: str) -> Path:
    """Return the local copy of the safetensors file at `url`. The first use downloads the file.

    Copies are kept in the folder that the environment variable QGS_CACHE names, by default in
    ~/.cache/qgs. A damaged copy is downloaded again. Raises OSError if the download fails or is not
    a complete safetensors file.
    """
    name = without_secrets(url)
    try:
        last = PurePosixPath(urlsplit(url).path).name
    except ValueError as error:
        raise OSError(f"{name} is not a valid URL: {error}") from None
    cache = Path(os.environ.get("QGS_CACHE") or "~/.cache/qgs").expanduser()
    # By the whole URL: two servers may have files of one name.
    key = hashlib.sha256(url.encode()).hexdigest()[:16]
    # A file name may have 255 bytes.
    file = cache / key / (last.strip(".")[-50:] or "checkpoint")
    if file.is_file() and not _is_whole(file):
        warn_once(f"{file} is damaged and is downloaded again")
        file.unlink()
    if not file.is_file():
        _download(url, file)
    warn_once(f"{name} is kept as {file} (delete this file to download it again)")
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
                raise ValueError(
                    "the data are no complete safetensors file, perhaps a web page; check the URL"
                )
    # The file system of the URL may raise anything.
    except Exception as error:
        cause = str(getattr(error, "reason", error)) or type(error).__name__
        if isinstance(error, HTTPError):
            cause = f"the server answers {error.code} ({error.reason})"
        text = f"{url} could not be downloaded; nothing was kept: {cause}"
        # `from None`: the error itself may show a password.
        raise OSError(without_secrets(text)) from None


def _copy(stream: Any, local: IO[bytes], folder: Path) -> None:
    """Copy `stream` to `local`. Raises OSError if the data exceed LARGEST or the free space."""
    announced = getattr(stream, "length", None) or getattr(stream, "size", None) or 0
    # A server may announce less than it sends, or nothing.
    limit = min(LARGEST, shutil.disk_usage(folder).free)
    left = limit
    while announced <= limit and left > 0 and (part := stream.read(2**20)):
        local.write(part)
        left -= len(part)
    if announced > limit or left <= 0:
        raise OSError(
            f"the file is larger than the download limit or the free disk space, {decimal(limit)}"
        )


def _opened(url: str) -> Any:
    """Open `url` for reading. User and password in `url` are sent by HTTP basic authentication."""
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
