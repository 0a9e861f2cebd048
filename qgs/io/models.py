"""Checkpoints by name: a path, a model that an installed plugin ships, or any URL of fsspec."""

import hashlib
import os
import shutil
import sys
from pathlib import Path, PurePosixPath
from urllib.parse import urlsplit

from safetensors import safe_open

from qgs import DISTRIBUTIONS
from qgs.composer.errors import did_you_mean
from qgs.composer.registry import available_plugins, load_plugin
from qgs.contracts.plugin import ENTRY_POINT_GROUP
from qgs.data.paths import opened_path
from qgs.io.files import replacing

CHECKPOINT = "checkpoint.safetensors"
"""In a run folder: the latest good weights."""


def checkpoint_path(name: str | os.PathLike[str]) -> Path:
    """The local file that `name` stands for; anything that exists under that name comes first.

    name: a path, of a run folder for the checkpoint in it, PLUGIN/NAME of a model that an installed
    plugin ships (`qgs list`), or a URL that fsspec opens, whose file is kept in `cache_folder` and
    its SHA-256 printed to standard error.
    Raises FileNotFoundError, PluginError for a plugin that cannot be used, OSError for a download
    that fails.
    """
    text = os.fspath(name)
    path = Path(text).expanduser()
    plugin, slash, model = text.partition("/")
    if path.exists():
        path = path / CHECKPOINT if path.is_dir() else path
    elif "://" in text:
        return _downloaded(text)
    elif slash and "/" not in model and path.suffix != ".safetensors":
        known = available_plugins().keys() | DISTRIBUTIONS[ENTRY_POINT_GROUP].keys()
        if plugin in known:
            return _shipped(plugin, text)
    if not path.is_file():
        raise FileNotFoundError(
            f"no checkpoint at {path}; give a run folder of `qgs train`, a .safetensors file, its "
            "URL, or PLUGIN/NAME of a model that `qgs list` shows"
        )
    return path


def _shipped(plugin: str, name: str) -> Path:
    installed = load_plugin(plugin)
    if name not in installed.models:
        hint = did_you_mean(name, installed.models, "models") if installed.models else "it has none"
        raise FileNotFoundError(
            f"there is no file {name}, and {installed.released_as} ships no model of that name; "
            f"{hint}"
        )
    file = installed.models[name]
    if not file.is_file():
        raise FileNotFoundError(
            f"{installed.released_as} should ship the model {name}, but {file} is not there; "
            f"install {installed.released_as} again"
        )
    return file


def card_of(file: Path) -> str:
    """The card of a model, NAME.md beside the checkpoint NAME.safetensors; "" without one."""
    card = file.with_suffix(".md")
    return card.read_text(encoding="utf-8") if card.is_file() else ""


def about(file: Path) -> str:
    """What the model in `file` is: the first paragraph of its card; "" without one."""
    paragraphs = [part for part in card_of(file).split("\n\n") if not part.startswith("#")]
    return " ".join(paragraphs[0].split()) if paragraphs else ""


def cache_folder() -> Path:
    """Where downloaded checkpoints are kept: the environment's QGS_CACHE, else ~/.cache/qgs."""
    return Path(os.environ.get("QGS_CACHE") or "~/.cache/qgs").expanduser()


def _downloaded(url: str) -> Path:
    """The file of a URL, downloaded unless it was before; only a whole safetensors file is kept."""
    source = opened_path(url)
    key = hashlib.sha256(url.encode()).hexdigest()[:16]
    file = cache_folder() / key / (PurePosixPath(urlsplit(url).path).name or "checkpoint")
    kept = "kept as"
    if file.is_file():
        kept = "not downloaded again (delete the file to do so); it was kept as"
    else:
        try:
            with replacing(file) as temporary:
                with source.open("rb") as remote, temporary.open("wb") as local:
                    shutil.copyfileobj(remote, local, 2**20)
                with safe_open(temporary, "pt"):
                    pass  # its header holds the size, so a truncated file is refused
        except Exception as error:  # whatever the file system of the URL raises
            reason = str(error) or type(error).__name__
            raise OSError(
                f"{url} could not be downloaded as a whole safetensors file ({reason}); nothing of "
                "it was kept. Check the URL and the connection, then try again"
            ) from error
    with file.open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
    print(f"{url}: sha256 {digest}, {kept} {file}", file=sys.stderr)
    return file
