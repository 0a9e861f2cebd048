"""Any source of scenes turned into chunks, which training reads fast."""

import json
import os
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import IO, Any, TypeAlias, get_args

import torch
from upath import UPath

from qgs.contracts import SceneSource, Split
from qgs.files import replacing
from qgs.paths import is_local
from qgs.wording import listed
from qgs_photos.datasets.chunk_files import INDEX, SUFFIX
from qgs_photos.datatools.entries import ChunkEntry, Encoding, chunk_entry, encoded_frames

CHUNK_BYTES = 100 * 2**20
JOURNAL = "packing.json"
_VERSION = 1

Places: TypeAlias = Mapping[str, tuple[Split, int]]
"""Scenes by name: the split of the source that has each, and its index there."""

# What is packed into which split.
Splits: TypeAlias = Mapping[Split, Places]


def own_splits(source: SceneSource) -> Splits:
    """Return the source's own splits; scenes in both are packed once, for training."""
    train = _places(source, "train")
    test = _places(source, "test")
    return {"train": train, "test": {name: test[name] for name in test if name not in train}}


def splits_by_list(source: SceneSource, test_scenes: Collection[str]) -> Splits:
    """Split all scenes, those named for testing. Raises ValueError for names of no scene."""
    places = _every_place(source)
    if absent := [name for name in test_scenes if name not in places]:
        raise ValueError(
            f"{len(absent)} of {len(test_scenes)} test scenes are not there: {listed(absent)}; the "
            f"{len(places)} scenes are called {listed(places)}. Correct the list, or take them out "
            "of it"
        )
    return _split(places, {*test_scenes})


def splits_by_number(source: SceneSource, every: int) -> Splits:
    """Split all scenes, every n-th of them for testing, beginning with scene n - 1."""
    places = _every_place(source)
    return _split(places, {*[*places][every - 1 :: every]})


def _every_place(source: SceneSource) -> Places:
    splits = own_splits(source)
    return {**splits["train"], **splits["test"]}


def _split(places: Places, test: Collection[str]) -> Splits:
    return {
        "train": {name: place for name, place in places.items() if name not in test},
        "test": {name: place for name, place in places.items() if name in test},
    }


def _places(source: SceneSource, split: Split) -> dict[str, tuple[Split, int]]:
    places: dict[str, tuple[Split, int]] = {}
    for index, name in enumerate(source.names(split)):
        if name in places:
            raise ValueError(
                f"two scenes are called {name!r}, and chunks identify scenes by name: rename one"
            )
        places[name] = split, index
    return places


@dataclass
class Journal:
    """A packing. settings: what decides its result. files: a scene's key to its whole chunk."""

    folder: UPath
    settings: Mapping[str, Any]
    files: dict[Split, dict[str, str]] = field(default_factory=lambda: {"train": {}, "test": {}})

    def save(self) -> None:
        """Write it beside the chunks, whole or not at all."""
        content = {"version": _VERSION, "settings": self.settings, "files": self.files}
        write_bytes(self.folder / JOURNAL, json.dumps(content).encode())


def open_journal(folder: UPath, settings: Mapping[str, Any]) -> Journal:
    """Open the journal in `folder`, a new one where nothing is there yet.

    Raises FileExistsError for other content, ValueError for other settings or a strange journal.
    """
    settings = json.loads(json.dumps(settings))
    file = folder / JOURNAL
    if not file.is_file():
        inside = folder.iterdir() if folder.is_dir() else ()
        if held := sorted(item.name for item in inside if not _is_unfinished(item)):
            raise FileExistsError(
                f"{folder} is not empty ({listed(held)}), and packing never overwrites: "
                "give a new folder"
            )
        return Journal(folder, settings)
    content = _read(file)
    before = content["settings"]
    other = [key for key in {**before, **settings} if before.get(key) != settings.get(key)]
    if content.get("version") != _VERSION or other:
        changed = "; ".join(f"{key} was {before.get(key)}, is {settings.get(key)}" for key in other)
        raise ValueError(
            f"{folder} holds an unfinished packing with other settings ({changed}): give those "
            "again to finish it, or give a new folder"
        )
    return Journal(folder, settings, content["files"])


def _read(file: UPath) -> Mapping[str, Any]:
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        files = content["files"]
        parts = [content["settings"], *(files[split] for split in get_args(Split))]
        if all(isinstance(part, dict) for part in parts):
            return content
        reason = "was not written by a packing"
    except ValueError as error:
        reason = f"is not valid JSON ({error})"
    except (KeyError, TypeError):
        reason = "was not written by a packing"
    raise ValueError(f"{file} {reason}: move it away if you know it, or give a new folder")


def _is_unfinished(path: UPath) -> bool:
    """Return whether a process was writing `path` by `opened_replacing` when it was killed."""
    return path.name.startswith(".") and path.suffix == ".tmp"


@dataclass
class Packed:
    """What a packing did: scenes by split; `resumed` of them were packed before.

    frames, kept: images written now, and those whose bytes stayed. left_out: scenes that could not
    be read, with the reason.
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
    """Write the scenes of `splits` to `folder`, as chunks of at most `chunk_bytes` or one scene.

    An interrupted packing goes on after its last complete chunk, if `settings`, which decide what
    the source holds, are the same; index.json comes last. leave_out_broken: unreadable scenes are
    left out, named in the result and tried again. progress: called with each finished scene.
    Raises FileExistsError for a folder with other content, ValueError and OSError as the scenes do.
    """
    encoding = encoding or Encoding()
    # chunks of two settings in one folder would be a data set that nobody asked for
    decides = {**settings, **asdict(encoding), "chunk_bytes": chunk_bytes}
    journal = open_journal(folder, decides)
    journal.save()
    packed = Packed()

    def entries(places: Places, done: Collection[str]) -> Iterator[ChunkEntry]:
        for name, (split, index) in places.items():
            try:
                if name in done:
                    packed.resumed += 1
                else:
                    yield _entry(name, source.scenes(split)[index], encoding, packed)
            except (ValueError, OSError) as error:
                if not leave_out_broken:
                    raise
                packed.left_out[name] = str(error)
            progress(name)

    for split, places in splits.items():
        done = journal.files[split]
        inside = folder / split
        for item in inside.iterdir() if inside.is_dir() else ():
            if _is_unfinished(item):
                item.unlink()
        for chunk in _chunks(entries(places, frozenset(done)), chunk_bytes):
            file = f"{len(set(done.values())):06d}{SUFFIX}"
            # first the chunk, then the journal: what it names is whole
            with opened_replacing(inside / file) as opened:
                torch.save(chunk, opened)
            done.update({entry["key"]: file for entry in chunk})
            journal.save()
    if not any(journal.files.values()):
        reasons = listed((f"{n}: {why}" for n, why in packed.left_out.items()), 3, "; ")
        raise ValueError(f"there is no scene to pack{': ' if reasons else ''}{reasons}")
    for split, files in journal.files.items():
        packed.scenes[split] = len(files)
        if files:
            write_bytes(folder / split / INDEX, json.dumps(files, indent=1).encode())
    (folder / JOURNAL).unlink()
    return packed


def _entry(name: str, scene: Any, encoding: Encoding, packed: Packed) -> ChunkEntry:
    frames, kept = zip(*encoded_frames(scene, encoding), strict=True)
    packed.frames += len(frames)
    packed.kept += sum(kept)
    return chunk_entry(name, frames, scene.held_out, scene.times)


def _chunks(entries: Iterable[ChunkEntry], limit: int) -> Iterator[list[ChunkEntry]]:
    chunk: list[ChunkEntry] = []
    total = 0
    for entry in entries:
        size = sum(data.nbytes for key in ("images", "masks") for data in entry.get(key, ()))
        if chunk and total + size > limit:
            yield chunk
            chunk = []
            total = 0
        chunk.append(entry)
        total += size
    if chunk:
        yield chunk


@contextmanager
def opened_replacing(path: UPath) -> Iterator[IO[bytes]]:
    """Open a file that replaces `path` when the block ends well; makes missing parent folders.

    Moving is as atomic as the file system's: object stores show an object when it is complete.
    """
    if is_local(path):
        with replacing(Path(str(path))) as temporary, temporary.open("wb") as file:
            yield file
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as file:
            yield file
        path.fs.mv(temporary.path, path.path)
    except BaseException:
        if temporary.exists():
            temporary.unlink()
        raise


def write_bytes(path: UPath, data: bytes) -> None:
    """Write `data` to `path`, whole or not at all."""
    with opened_replacing(path) as file:
        file.write(data)
