"""The scenes of chunks as candidates for a check, and what is wrong with files and index.json."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from typing import Any

import numpy as np
import torch
from upath import UPath

from qgs.data.check.conventions import OPENCV
from qgs.data.check.finding import Finding
from qgs.data.check.photo import Candidate, Photo
from qgs.data.chunks.listing import INDEX, SUFFIX, has_chunks, read_index
from qgs.data.chunks.record import Record, parse_record, unit_faults
from qgs.data.chunks.store import load_chunk
from qgs.data.frames import PhotoFrame, Size
from qgs.data.wording import a_type

_SHOWN = 3
_REPACK = "pack the data set again with `qgs data pack`, or copy the file again"


@dataclass
class ChunkFolder:
    """What one folder of chunks holds.

    index: scene to file name, as index.json has it; placed: the scenes of each file there. keys:
    scenes of each file that could be read; found: all of them. broken: those of these files with
    entries that are no scenes.
    """

    split: str
    folder: UPath
    index: Mapping[str, str] = field(default_factory=dict)
    placed: Mapping[str, Sequence[str]] = field(default_factory=dict)
    keys: dict[str, set[str]] = field(default_factory=dict)
    found: set[str] = field(default_factory=set)
    broken: set[str] = field(default_factory=set)
    candidates: list[Candidate] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)

    def label(self, name: str) -> str:
        """A file's name with that of its split."""
        return f"{self.split}/{name}" if self.split else name

    def tell(self, scene: str, reason: str, fix: str, *, warning: bool = False) -> None:
        """Add a finding."""
        severity = "warning" if warning else "error"
        self.findings.append(Finding(scene, reason, fix, severity=severity))


def chunk_folders(path: UPath) -> list[ChunkFolder]:
    """The folders of chunks of a data set: train and test, or `path`; or a single chunk file."""
    if path.is_file():
        folder = ChunkFolder("", path.parent)
        _add_chunk(folder, path)
        return [folder]
    parts = [(split, path / split) for split in ("train", "test") if has_chunks(path / split)]
    folders = [_folder(split, part) for split, part in parts or [("", path)]]
    _tell_shared(folders)
    return folders


def _folder(split: str, path: UPath) -> ChunkFolder:
    folder = ChunkFolder(split, path)
    indexed = _read_index(folder) if (path / INDEX).is_file() else False
    for file in sorted((item for item in path.iterdir() if item.suffix == SUFFIX), key=str):
        _add_chunk(folder, file)
    if indexed:
        _compare_index(folder)
    return folder


def _read_index(folder: ChunkFolder) -> bool:
    try:
        folder.index = read_index(folder.folder / INDEX)
    except (OSError, ValueError) as error:
        folder.tell(folder.label(INDEX), str(error), "write it anew: scene to chunk file, in JSON")
        return False
    placed: dict[str, list[str]] = {}
    for key, name in folder.index.items():
        placed.setdefault(name, []).append(key)
    folder.placed = placed
    return True


def _add_chunk(folder: ChunkFolder, file: UPath) -> None:
    """The scenes of a file. Entries that cannot be parsed are told, the others are candidates."""
    try:
        entries = load_chunk(file)
    except (OSError, ValueError) as error:
        folder.tell(folder.label(file.name), _reason(error, file) + _lost(folder, file), _REPACK)
        return
    keys = folder.keys[file.name] = set()
    if not entries:
        folder.tell(folder.label(file.name), "the chunk holds no scene", _REPACK)
    strange: list[Any] = []
    for place, entry in enumerate(entries):
        if not _has_key(entry):
            strange.append(entry)
            continue
        key = entry["key"]
        if key in folder.found:
            folder.tell(
                key,
                f"the scene is in {folder.label(file.name)}, and was in this split before",
                "remove one of the two, or pack the data set again with `qgs data pack`",
            )
            continue
        keys.add(key)
        folder.found.add(key)
        photos = partial(_photos, file, place)
        folder.candidates.append(Candidate(key, key, "chunks", OPENCV, photos, folder.split))
    if strange:
        folder.broken.add(file.name)
        folder.tell(
            folder.label(file.name),
            f"{len(strange)} of its {len(entries)} entries are no mappings with a 'key' (the first "
            f"is {a_type(strange[0])})" + _lost(folder, file),
            _REPACK,
        )


def _has_key(entry: Any) -> bool:
    return isinstance(entry, Mapping) and isinstance(entry.get("key"), str)


def _lost(folder: ChunkFolder, file: UPath) -> str:
    """The scenes that a broken file was to hold, in words."""
    read = folder.keys.get(file.name, ())
    keys = [key for key in folder.placed.get(file.name, ()) if key not in read]
    return f"; {INDEX} places there {_listed(keys)}" if keys else ""


def _listed(keys: Sequence[str]) -> str:
    more = f" and {len(keys) - _SHOWN} more" if len(keys) > _SHOWN else ""
    return f"{len(keys)} scene{'s' if len(keys) > 1 else ''}: {', '.join(keys[:_SHOWN])}{more}"


def _reason(error: Exception, file: UPath) -> str:
    """What was raised, less the remedy behind the last colon."""
    told = " ".join(str(error).replace(f"{file} ", "the file ").split())
    return told.rpartition(": ")[0] or told


def _compare_index(folder: ChunkFolder) -> None:
    index = folder.index
    files = {item.name for item in folder.folder.iterdir()}
    for name, keys in folder.placed.items():
        if name not in files:
            _tell_absent(folder, name, keys)
    for key, name in index.items():
        if name in folder.keys and key not in folder.keys[name] and name not in folder.broken:
            folder.tell(
                key,
                f"{folder.label(INDEX)} places the scene in {name}, which does not hold it",
                f"take the scene out of {INDEX}, or get the chunk that holds it",
            )
    for name, keys in folder.keys.items():
        for key in sorted(keys - index.keys()):
            folder.tell(
                key,
                f"{folder.label(name)} holds the scene, but {folder.label(INDEX)} does not name "
                "it, so that it is never read",
                f"add it to {INDEX}",
                warning=True,
            )


def _tell_absent(folder: ChunkFolder, name: str, keys: Sequence[str]) -> None:
    folder.tell(
        folder.label(name),
        f"the chunk does not exist; {INDEX} places there {_listed(keys)}",
        f"download the chunk, or take its scenes out of {INDEX}",
    )


def _tell_shared(folders: Sequence[ChunkFolder]) -> None:
    splits = [folder.found for folder in folders]
    for key in sorted(set.intersection(*splits)) if len(splits) > 1 else ():
        folders[0].tell(
            key,
            "the scene is in train and in test, so that models are judged on what they have seen",
            "remove it from one of the two",
            warning=True,
        )


@lru_cache(maxsize=1)
def _entries(file: UPath) -> list[Any]:
    return load_chunk(file)


def _photos(file: UPath, place: int) -> list[Photo]:
    record = parse_record(str(file), _entries(file)[place])
    sizes = _listed_sizes(record)
    judged = record if sizes is None else replace(record, sizes=torch.tensor(sizes))
    return list(_frames(file, judged, sizes))


def _frames(file: UPath, record: Record, sizes: Sequence[Size] | None) -> Iterator[Photo]:
    for frame in range(len(record)):
        size = sizes[frame] if sizes is not None else None
        height, width = size or (1, 1)
        fx, fy, cx, cy = record.cameras[frame, :4].double().tolist()
        listed = PhotoFrame(
            name=record.names[frame],
            path=file,
            c2w=_inverse(record.w2c[frame].numpy()),
            intrinsics=(fx * width, fy * height, cx * width, cy * height),
            size=size,
            faults=tuple(unit_faults(record, frame)),
        )
        yield Photo(listed, partial(_bytes, record, frame))


def _bytes(record: Record, frame: int) -> bytes:
    return record.images[frame].numpy().tobytes()


def _inverse(matrix: np.ndarray) -> np.ndarray:
    try:
        return np.linalg.inv(matrix)
    except np.linalg.LinAlgError:
        return np.full((4, 4), np.nan)


def _listed_sizes(record: Record) -> list[Size] | None:
    """(H, W) of every image: as the chunk says, else what most of the scene's headers say."""
    if record.sizes is not None:
        return record.image_sizes
    stored: Counter[Size] = Counter()
    for frame in range(len(record)):
        try:
            stored[record.stored_size(frame)] += 1
        except ValueError:
            continue
    return [stored.most_common(1)[0][0]] * len(record) if stored else None
