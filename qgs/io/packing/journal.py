"""What a packing has finished, so that an interrupted one goes on where it was."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, get_args

from upath import UPath

from qgs.contracts import Split
from qgs.io.urls import write_bytes

JOURNAL = "packing.json"
_VERSION = 1


@dataclass
class Journal:
    """The state of a packing into `folder`.

    settings: what decides the result; another packing must not go on with it. files: of each split
    a scene's key to its chunk, for chunks that are complete.
    """

    folder: UPath
    settings: Mapping[str, Any]
    files: dict[Split, dict[str, str]] = field(default_factory=lambda: {"train": {}, "test": {}})

    def save(self) -> None:
        """Write it beside the chunks, whole or not at all."""
        content = {"version": _VERSION, "settings": self.settings, "files": self.files}
        write_bytes(self.folder / JOURNAL, json.dumps(content).encode())

    def remove(self) -> None:
        """Forget it, once all is complete."""
        (self.folder / JOURNAL).unlink()


def open_journal(folder: UPath, settings: Mapping[str, Any]) -> Journal:
    """The journal in `folder`, a new one where nothing is there yet.

    Raises FileExistsError for a folder that holds something else, and ValueError for one with an
    unfinished packing of other settings, or with a journal that is none.
    """
    settings = json.loads(json.dumps(settings))
    file = folder / JOURNAL
    if not file.is_file():
        held = _held(folder)
        if held:
            raise FileExistsError(
                f"{folder} is not empty ({', '.join(held[:5])}), and packing never overwrites: "
                "give a new folder"
            )
        return Journal(folder, settings)
    content = _read(file)
    before = content["settings"]
    other = [key for key in {**before, **settings} if before.get(key) != settings.get(key)]
    if content.get("version") != _VERSION or other:
        said = "; ".join(f"{key} was {before.get(key)}, is {settings.get(key)}" for key in other)
        raise ValueError(
            f"{folder} holds an unfinished packing with other settings ({said}): give those again "
            "to finish it, or give a new folder"
        )
    return Journal(folder, settings, content["files"])


def _read(file: UPath) -> Mapping[str, Any]:
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(_foreign(file, f"is not valid JSON ({error})")) from error
    whole = isinstance(content, dict) and isinstance(content.get("settings"), dict)
    files = content.get("files") if whole else None
    if not isinstance(files, dict) or not all(
        isinstance(files.get(s), dict) for s in get_args(Split)
    ):
        raise ValueError(_foreign(file, "was not written by a packing"))
    return content


def _foreign(file: UPath, reason: str) -> str:
    return f"{file} {reason}: move it away if you know it, or give a new folder"


def _held(folder: UPath) -> list[str]:
    """What a folder holds, but for files that a killed process was writing."""
    if not folder.is_dir():
        return []
    return sorted(item.name for item in folder.iterdir() if not is_temporary(item))


def is_temporary(path: UPath) -> bool:
    """Whether `path` is a file that `opened_replacing` was writing when its process was killed."""
    return path.name.startswith(".") and path.suffix == ".tmp"
