"""Checkpoints by name: a path, a model that an installed plugin ships, or any URL of fsspec."""

import os
from pathlib import Path

from qgs.checkpoint.download import downloaded
from qgs.recipe.errors import did_you_mean
from qgs.recipe.registry import available_plugins, load_plugin

CHECKPOINT = "checkpoint.safetensors"
"""In a run folder: the latest good weights."""


def checkpoint_path(name: str | os.PathLike[str]) -> Path:
    """Return the local file of `name`; what exists under that name comes first.

    name: a path, of a run folder for the checkpoint in it, PLUGIN/NAME of a model that an installed
    plugin ships (`qgs list`), or a URL that fsspec opens, see `qgs.checkpoint.download`.
    Raises FileNotFoundError, PluginError for a plugin that cannot be used, OSError for a
    download that fails.
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
        if is_name and plugin in available_plugins():
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
        hint = did_you_mean(name, installed.models, "models")
        raise FileNotFoundError(f"{installed.released_as} ships no model {name}; {hint}")
    file = installed.models[name]
    if not file.is_file():
        raise FileNotFoundError(
            f"{installed.released_as} should ship the model {name}, but {file} is not there; "
            f"install {installed.released_as} again"
        )
    return file


def card_of(file: Path) -> str:
    """Return the card of a model, NAME.md beside NAME.safetensors; "" without one."""
    card = file.with_suffix(".md")
    return card.read_text(encoding="utf-8") if card.is_file() else ""


def about(file: Path) -> str:
    """Return the first paragraph of the card of the model in `file`; "" without one."""
    paragraphs = (part for part in card_of(file).split("\n\n") if not part.startswith("#"))
    return " ".join(next(paragraphs, "").split())
