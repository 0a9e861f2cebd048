"""Which scenes a folder of chunks holds, and where."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from dataclasses import dataclass

from upath import UPath

from qgs.data.chunks.store import chunks_of
from qgs.data.paths import stays_inside

_log = logging.getLogger(__name__)

INDEX = "index.json"
SUFFIX = ".torch"


@dataclass(frozen=True)
class Listing:
    """Scenes of one folder, in the index's order.

    files: a scene's key to its chunk file. missing: the same for chunks that do not exist.
    """

    folder: UPath
    files: Mapping[str, UPath]
    missing: Mapping[str, UPath]


def has_chunks(folder: UPath) -> bool:
    """Whether a folder looks like one of chunks: it holds an index.json or .torch files."""
    return folder.is_dir() and (
        (folder / INDEX).is_file() or any(item.suffix == SUFFIX for item in folder.iterdir())
    )


def read_index(path: UPath) -> dict[str, str]:
    """An index.json: key to file name. Raises ValueError for what it cannot mean."""
    try:
        index = json.loads(path.read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(
            f"{path} is not valid JSON ({error}): copy it again, or remove it to have the chunks "
            "read instead"
        ) from error
    if not isinstance(index, dict) or not all(isinstance(name, str) for name in index.values()):
        raise ValueError(f"{path} must map each scene's key to the name of its chunk file")
    outside = {name for name in set(index.values()) if not stays_inside(name)}
    for key, name in index.items():
        if name in outside:
            raise ValueError(
                f"{path} places the scene {key!r} in {name!r}, outside its own folder: such an "
                "index is not read"
            )
    return index


def list_scenes(folder: UPath) -> Listing:
    """The scenes of a folder, from index.json alone where there is one; else chunks are opened.

    Scenes whose chunk does not exist are counted and named in a warning. Raises FileNotFoundError
    when no scene is left, ValueError for an index or a chunk that cannot be read.
    """
    if not (folder / INDEX).is_file():
        return Listing(folder, _scanned(folder), {})
    index = read_index(folder / INDEX)
    present = {item.name for item in folder.iterdir()}
    chunks = {name: folder / name for name in set(index.values())}
    there = {name for name in chunks if name in present or chunks[name].is_file()}
    here = {key: chunks[name] for key, name in index.items() if name in there}
    missing = {key: chunks[name] for key, name in index.items() if name not in there}
    if not here:
        raise FileNotFoundError(
            f"{folder / INDEX} names {len(index)} scenes, and none of their chunks exists: "
            "download the chunks beside it"
        )
    if missing:
        _log.warning(
            "%d of %d scenes of %s are left out, because their chunks do not exist: %s",
            len(missing), len(index), folder / INDEX,
            ", ".join(f"{key} ({file.name})" for key, file in missing.items()),
        )  # fmt: skip
    return Listing(folder, here, missing)


def _scanned(folder: UPath) -> dict[str, UPath]:
    paths = sorted((item for item in folder.iterdir() if item.suffix == SUFFIX), key=str)
    if not paths:
        raise FileNotFoundError(
            f"{folder} holds neither {INDEX} nor chunks ({SUFFIX} files): give the folder that "
            "holds train/ and test/"
        )
    files: dict[str, UPath] = {}
    for chunk in chunks_of(paths):
        for key in chunk.keys:
            if key in files:
                raise ValueError(
                    f"the scene {key!r} is in {files[key].name} and in {chunk.path.name} of "
                    f"{folder}: remove one of the files, or write an {INDEX}"
                )
            files[key] = chunk.path
    _log.warning(
        "%s has no %s: all of its %d chunks were opened to list %d scenes, which happens at every "
        "start", folder, INDEX, len(paths), len(files),
    )  # fmt: skip
    return files
