"""Chunks of a data set: their scenes, to be checked, and what is wrong with the files."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any

import numpy as np
import torch
from upath import UPath

from qgs.data.lenses import Size
from qgs.data.photos.reader import PhotoFrame
from qgs.wording import counted, listed
from qgs_photos.datasets.chunk_files import (
    INDEX,
    SUFFIX,
    Record,
    a_type,
    has_chunks,
    load_chunk,
    parse_record,
    read_chunk_index,
    read_mask,
    unit_problems,
)
from qgs_photos.datatools.candidates import Candidate, Photo
from qgs_photos.datatools.findings import Finding, Severity

_REPACK = "pack the data set again with `qgs data pack`, or copy the file again"


def chunk_folders(path: UPath) -> list[ChunkFolder]:
    """Read the folders of chunks of a data set: train and test, or `path`; or a single file."""
    if path.is_file():
        single = ChunkFolder("")
        single.add_chunk(path)
        return [single]
    parts = {split: path / split for split in ("train", "test") if has_chunks(path / split)}
    folders: list[ChunkFolder] = []
    for split, part in (parts or {"": path}).items():
        folder = ChunkFolder(split)
        indexed = folder.read_index(part / INDEX)
        for file in sorted((item for item in part.iterdir() if item.suffix == SUFFIX), key=str):
            folder.add_chunk(file)
        if indexed:
            folder.compare_index({item.name for item in part.iterdir()})
        folders.append(folder)
    if len(folders) == 2:
        reason = (
            "the scene is in train and in test, so that models are evaluated on scenes of their "
            "training"
        )
        for key in sorted(folders[0].found & folders[1].found):
            folders[0].report(key, reason, "remove it from one of the two", "warning")
    return folders


class ChunkFolder:
    """Content of a folder of chunks. split: train, test or empty. index, found: scenes."""

    def __init__(self, split: str) -> None:
        self.split = split
        self.index: Mapping[str, str] = {}
        self.found: set[str] = set()
        self.candidates: list[Candidate] = []
        self.findings: list[Finding] = []
        # scenes by file, as in the index
        self._placed: dict[str, list[str]] = defaultdict(list)
        # scenes by file, of files that could be read
        self._keys: dict[str, set[str]] = {}
        # files with entries that are no scenes
        self._broken: set[str] = set()

    def report(self, scene: str, reason: str, fix: str, severity: Severity = "error") -> None:
        """Add a finding."""
        self.findings.append(Finding(scene, reason, fix, severity=severity))

    def read_index(self, file: UPath) -> bool:
        """Read index.json; return whether there is a readable one."""
        if not file.is_file():
            return False
        try:
            self.index = read_chunk_index(file)
        except (OSError, ValueError) as error:
            self.report(self._label(INDEX), str(error), "write it anew: scene to file, in JSON")
            return False
        for key, name in self.index.items():
            self._placed[name].append(key)
        return True

    def add_chunk(self, file: UPath) -> None:
        """Add the scenes of a file as candidates, and findings on entries that cannot be parsed."""
        label = self._label(file.name)
        try:
            entries = load_chunk(file)
        except (OSError, ValueError) as error:
            text = " ".join(str(error).replace(f"{file} ", "the file ").split())
            # without the remedy behind the last colon
            reason = text.rpartition(": ")[0] or text
            self.report(label, reason + self._lost(file.name), _REPACK)
            return
        keys = self._keys[file.name] = set()
        if not entries:
            self.report(label, "the chunk holds no scene", _REPACK)
        strange: list[Any] = []
        for place, entry in enumerate(entries):
            key = entry.get("key") if isinstance(entry, Mapping) else None
            if not isinstance(key, str):
                strange.append(entry)
            elif key in self.found:
                reason = f"the scene is in {label}, and was in this split before"
                self.report(key, reason, f"remove one of the two, or {_REPACK}")
            else:
                keys.add(key)
                self.found.add(key)
                photos = partial(_photos, file, place)
                self.candidates.append(
                    Candidate(name=key, scene=key, kind="chunks", photos=photos, split=self.split)
                )
        if strange:
            self._broken.add(file.name)
            self.report(
                label,
                f"{len(strange)} of its {len(entries)} entries are no mappings with a 'key' (the "
                f"first is {a_type(strange[0])})" + self._lost(file.name),
                _REPACK,
            )

    def compare_index(self, files: set[str]) -> None:
        """Report where the index and the folder's `files` differ."""
        index = self._label(INDEX)
        if not self.index:
            self.report(index, "it names no scene", "remove it, or write it anew")
        for name, keys in self._placed.items():
            if name not in files:
                reason = f"the chunk does not exist; {INDEX} places there {_scenes(keys)}"
                fix = f"download the chunk, or take its scenes out of {INDEX}"
                self.report(self._label(name), reason, fix)
        for key, name in self.index.items():
            if name in self._keys and key not in self._keys[name] and name not in self._broken:
                reason = f"{index} places the scene in {name}, which does not hold it"
                fix = f"take the scene out of {INDEX}, or get the chunk that holds it"
                self.report(key, reason, fix)
        for name, keys in self._keys.items():
            reason = (
                f"{self._label(name)} holds the scene, but {index} does not name it, so that it is "
                "never read"
            )
            for key in sorted(keys - self.index.keys()):
                self.report(key, reason, f"add it to {INDEX}", "warning")

    def _label(self, name: str) -> str:
        return f"{self.split}/{name}" if self.split else name

    def _lost(self, name: str) -> str:
        """Return text on the scenes that the index places in a broken file."""
        keys = [k for k in self._placed.get(name, ()) if k not in self._keys.get(name, ())]
        return f"; {INDEX} places there {_scenes(keys)}" if keys else ""


def _scenes(keys: Sequence[str]) -> str:
    return f"{counted(len(keys), 'scene')}: {listed(keys)}"


@lru_cache(maxsize=1)
def _entries(file: UPath) -> list[Any]:
    return load_chunk(file)


def _photos(file: UPath, place: int) -> list[Photo]:
    record = parse_record(str(file), _entries(file)[place])
    sizes = _listed_sizes(record)
    # without sizes each image would be opened again to know its own
    judged = record if sizes is None else replace(record, sizes=torch.tensor(sizes))
    return [_photo(file, judged, i, sizes[i] if sizes else None) for i in range(len(record))]


def _photo(file: UPath, record: Record, frame: int, size: Size | None) -> Photo:
    try:
        c2w = np.linalg.inv(record.w2c[frame].numpy())
    # a singular matrix is told as a pose with NaN
    except np.linalg.LinAlgError:
        c2w = np.full((4, 4), np.nan)
    photo = PhotoFrame(
        name=record.names[frame],
        path=file,
        c2w=c2w,
        intrinsics=record.intrinsics(frame, size or (1, 1)),
        size=size,
        time=None if record.times is None else float(record.times[frame]),
        problems=tuple(unit_problems(record, frame)),
    )
    return Photo(
        photo,
        lambda: record.images[frame].numpy().tobytes(),
        read_mask=lambda: read_mask(record, frame),
    )


def _listed_sizes(record: Record) -> list[Size] | None:
    """Return (H, W) of every image: as the chunk says, else what most of the headers say."""
    if record.sizes is not None:
        return record.image_sizes
    stored: Counter[Size] = Counter()
    for frame in range(len(record)):
        try:
            stored[record.stored_size(frame)] += 1
        except ValueError:
            continue
    return [stored.most_common(1)[0][0]] * len(record) if stored else None
