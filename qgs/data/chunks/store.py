"""Chunk files, opened when a scene of theirs is wanted."""

from __future__ import annotations

import io
import re
import zipfile
from collections import OrderedDict
from collections.abc import Iterator
from threading import Lock
from typing import Any

import torch
from upath import UPath

from qgs.data.chunks.record import Record, parse_record
from qgs.data.paths import is_local
from qgs.data.wording import a_type

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
