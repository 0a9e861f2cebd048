"""Packing: scenes to chunks, one chunk in memory at a time."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import torch
from upath import UPath

from qgs.contracts import Scene, SceneSource, Split
from qgs.data.chunks.listing import INDEX, SUFFIX
from qgs.io.packing.frames import Encoding, packed_frames
from qgs.io.packing.journal import Journal, is_temporary, open_journal
from qgs.io.packing.records import ChunkEntry, chunk_entry, stored_bytes
from qgs.io.packing.splits import Places, Splits
from qgs.io.urls import opened_replacing, write_bytes

CHUNK_BYTES = 100 * 2**20


@dataclass
class Packed:
    """What a packing did.

    scenes: packed, by split, those of interrupted packings included. resumed: those of them that
    were packed before. frames, kept: images written now, and those of them whose bytes stayed as
    they were. left_out: scenes that could not be read, with the reason.
    """

    scenes: dict[Split, int] = field(default_factory=dict)
    resumed: int = 0
    frames: int = 0
    kept: int = 0
    left_out: dict[str, str] = field(default_factory=dict)


def pack(
    source: SceneSource,
    splits: Splits,
    folder: UPath,
    settings: Mapping[str, Any],
    encoding: Encoding | None = None,
    *,
    chunk_bytes: int = CHUNK_BYTES,
    leave_out_broken: bool = False,
    progress: Callable[[str], None] = lambda scene: None,
) -> Packed:
    """Write the scenes of `splits` as chunks to `folder`/train and `folder`/test.

    A chunk is closed before it would pass `chunk_bytes`, unless it is one scene. An interrupted
    packing goes on after its last complete chunk when it is called again; until all is complete
    there is no index.json.

    settings: everything that decides what the source holds, as JSON; a packing with others does not
    go on. leave_out_broken: whether scenes that cannot be read are left out, counted and named in
    the result; a packing that goes on tries them again. progress: told each scene that is dealt
    with.
    Raises FileExistsError for a folder with other content, ValueError and OSError as the scenes do.
    """
    encoding = encoding or Encoding()
    decides = {**settings, **asdict(encoding), "chunk_bytes": chunk_bytes}
    journal = open_journal(folder, decides)
    journal.save()
    packed = Packed()
    for split, places in splits.items():
        packer = _Packer(journal, split, encoding, chunk_bytes, leave_out_broken, packed)
        packer.run(source, places, progress)
    if not any(journal.files.values()):
        reasons = "; ".join(f"{name}: {reason}" for name, reason in packed.left_out.items())
        raise ValueError(f"there is no scene to pack{': ' if reasons else ''}{reasons}")
    for split, files in journal.files.items():
        packed.scenes[split] = len(files)
        if files:
            write_bytes(folder / split / INDEX, json.dumps(files, indent=1).encode())
    journal.remove()
    return packed


class _Packer:
    """The chunk of one split that is being filled."""

    def __init__(
        self,
        journal: Journal,
        split: Split,
        encoding: Encoding,
        chunk_bytes: int,
        leave_out_broken: bool,
        packed: Packed,
    ) -> None:
        self._split: Split = split
        self._journal, self._encoding = journal, encoding
        self._limit, self._leave_out_broken, self._packed = chunk_bytes, leave_out_broken, packed
        self._entries: list[ChunkEntry] = []
        self._bytes = 0

    def run(self, source: SceneSource, places: Places, progress: Callable[[str], None]) -> None:
        """Pack the scenes that are not packed yet."""
        done = self._journal.files[self._split]
        _clear(self._journal.folder / self._split)
        for name, place in places.items():
            if name in done:
                self._packed.resumed += 1
            else:
                self._add(name, source.scenes(place.split)[place.index])
            progress(name)
        self._flush()

    def _add(self, name: str, scene: Scene) -> None:
        try:
            entry = self._entry(name, scene)
        except (ValueError, OSError) as error:
            if not self._leave_out_broken:
                raise
            self._packed.left_out[name] = str(error)
            return
        size = stored_bytes(entry)
        if self._entries and self._bytes + size > self._limit:
            self._flush()
        self._entries.append(entry)
        self._bytes += size

    def _entry(self, name: str, scene: Scene) -> ChunkEntry:
        frames, kept = [], 0
        for frame, stays in packed_frames(scene, self._encoding):
            frames.append(frame)
            kept += stays
        self._packed.frames += len(frames)
        self._packed.kept += kept
        return chunk_entry(name, frames, scene.held_out)

    def _flush(self) -> None:
        if not self._entries:
            return
        done = self._journal.files[self._split]
        file = f"{len(set(done.values())):06d}{SUFFIX}"
        with opened_replacing(self._journal.folder / self._split / file) as opened:
            torch.save(self._entries, opened)
        done.update({entry["key"]: file for entry in self._entries})
        self._entries, self._bytes = [], 0
        self._journal.save()


def _clear(folder: UPath) -> None:
    """Remove what a killed packing was writing."""
    for item in folder.iterdir() if folder.is_dir() else ():
        if is_temporary(item):
            item.unlink()
