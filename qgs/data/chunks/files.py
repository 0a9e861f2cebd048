"""Files of chunks: reading and writing them, and which scenes a folder holds."""

from __future__ import annotations

import io
import json
import logging
import re
import zipfile
from collections import OrderedDict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from threading import Lock
from typing import Any

import torch
from upath import UPath

from qgs.data.chunks.record import Record, parse_record
from qgs.data.lazy import a_type
from qgs.data.paths import is_local, stays_inside

_COLOURS = re.compile(r"\x1b\[[0-9;]*m")


def load_chunk(path: UPath) -> list[Any]:
    """The entries of a chunk, unpickled as tensors and plain containers only.

    A local file of torch's zip format is memory-mapped, so that no image is read before it is
    used; others are read whole. Raises FileNotFoundError, and ValueError for a file that is no
    list.
    """
    try:
        data = _load(path)
    except FileNotFoundError:
        raise FileNotFoundError(
            f"chunk {path} does not exist: download it, or take its scenes out of index.json"
        ) from None
    except Exception as error:
        raise ValueError(
            f"{path} cannot be read as a torch file of tensors and lists ({_told(error)}): copy or "
            "pack it again"
        ) from error
    if not isinstance(data, list):
        raise ValueError(
            f"{path} holds {a_type(data)}, expected a list of mappings: is it a chunk of "
            "RealEstate10K's format?"
        )
    return data


def _told(error: Exception) -> str:
    """Why torch refuses a file, without its advice to trust it and without its colours."""
    said = str(error)
    if "Unsupported" in said:
        return "it holds Python objects, whose reading could run code"
    if type(error).__name__ in ("UnpicklingError", "EOFError") or "central directory" in said:
        return "it is cut off or no torch file"
    return _COLOURS.sub("", said or type(error).__name__).splitlines()[0]


def _load(path: UPath) -> Any:
    if not is_local(path):
        return torch.load(io.BytesIO(path.read_bytes()), map_location="cpu", weights_only=True)
    mapped = path.stat().st_size > 0 and zipfile.is_zipfile(str(path))
    return torch.load(str(path), map_location="cpu", weights_only=True, mmap=mapped)


class Chunk:
    """An open chunk: its scenes by key, parsed when asked for."""

    def __init__(self, path: UPath) -> None:
        self.path = path
        self._entries = load_chunk(path)
        self._by_key: dict[str, int] = {}
        self._parsed: dict[str, Record] = {}
        for place, entry in enumerate(self._entries):
            key = entry.get("key") if isinstance(entry, dict) else None
            if not isinstance(key, str):
                parse_record(f"{path}: entry {place}", entry)
            elif self._by_key.setdefault(key, place) != place:
                raise ValueError(
                    f"{path} holds the scene {key!r} twice: pack the data set again with "
                    "`qgs data pack`"
                )

    @property
    def keys(self) -> list[str]:
        """Keys in the file's order."""
        return list(self._by_key)

    def frames(self, key: str) -> int:
        """Number of frames of a scene. Raises as `record`."""
        return len(self.record(key))

    def record(self, key: str) -> Record:
        """A scene. Raises ValueError when it is not in this chunk or is malformed."""
        if key not in self._by_key:
            raise ValueError(
                f"{self.path} does not hold the scene {key!r}, which index.json places there: it "
                f"holds {', '.join(self.keys[:5])}{', ...' if len(self.keys) > 5 else ''}. Remove "
                "index.json to have the chunks read instead, or pack the data set again"
            )
        if key not in self._parsed:
            self._parsed[key] = parse_record(str(self.path), self._entries[self._by_key[key]])
        return self._parsed[key]


class ChunkStore:
    """The chunks opened last, at most `limit` of them, shared by threads.

    A copy made by pickling starts empty, so that worker processes open files of their own.
    """

    def __init__(self, limit: int = 4) -> None:
        self._limit = limit
        self.__setstate__({"_limit": limit})

    def __getstate__(self) -> dict[str, Any]:
        return {"_limit": self._limit}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self._limit: int = state["_limit"]
        self._open: OrderedDict[str, Chunk] = OrderedDict()
        self._lock = Lock()

    def chunk(self, path: UPath) -> Chunk:
        """The chunk in a file, opened unless it still is. Raises as `load_chunk`."""
        name = str(path)
        with self._lock:
            if name not in self._open:
                while len(self._open) >= self._limit:
                    self._open.popitem(last=False)
                self._open[name] = Chunk(path)
            self._open.move_to_end(name)
            return self._open[name]


def chunks_of(paths: list[UPath]) -> Iterator[Chunk]:
    """The chunks in files, one open at a time."""
    for path in paths:
        yield Chunk(path)


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


def read_chunk_index(path: UPath) -> dict[str, str]:
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
    index = read_chunk_index(folder / INDEX)
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
