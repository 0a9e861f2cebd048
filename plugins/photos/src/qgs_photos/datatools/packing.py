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

Splits: TypeAlias = Mapping[Split, Places]  # what is packed into which split


def own_splits(source: SceneSource) -> Splits:
    """The source's own splits; scenes that are in both are packed once, for training."""
    train, test = _places(source, "train"), _places(source, "test")
    return {"train": train, "test": {name: test[name] for name in test if name not in train}}


def splits_by_list(source: SceneSource, test_scenes: Collection[str]) -> Splits:
    """All scenes, those named for testing. Raises ValueError for names that no scene has."""
    splits = own_splits(source)
    places = [*splits["train"], *splits["test"]]
    if absent := [name for name in test_scenes if name not in set(places)]:
        raise ValueError(
            f"{len(absent)} of {len(test_scenes)} test scenes are not there: {listed(absent)}; the "
            f"{len(places)} scenes are called {listed(places)}. Correct the list, or take them out "
            "of it"
        )
    return _split_again(splits, set(test_scenes))


def splits_by_number(source: SceneSource, every: int) -> Splits:
    """All scenes, every n-th of them for testing, beginning with scene n - 1."""
    splits = own_splits(source)
    return _split_again(splits, {*[*splits["train"], *splits["test"]][every - 1 :: every]})


def _split_again(splits: Splits, test: Collection[str]) -> Splits:
    again: dict[Split, dict[str, tuple[Split, int]]] = {"train": {}, "test": {}}
    for name, place in {**splits["train"], **splits["test"]}.items():
        again["test" if name in test else "train"][name] = place
    return again


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
    """The journal in `folder`, a new one where nothing is there yet.

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
    except ValueError as error:
        reason = f"is not valid JSON ({error})"
    else:
        of_ours = isinstance(content, dict) and isinstance(content.get("settings"), dict)
        files = content.get("files") if of_ours else None
        if isinstance(files, dict) and all(isinstance(files.get(s), dict) for s in get_args(Split)):
            return content
        reason = "was not written by a packing"
    raise ValueError(f"{file} {reason}: move it away if you know it, or give a new folder")


def _is_unfinished(path: UPath) -> bool:
    """Whether `path` is a file that `opened_replacing` was writing when its process was killed."""
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
    decides = {**settings, **asdict(encoding), "chunk_bytes": chunk_bytes}
    journal = open_journal(folder, decides)
    journal.save()
    packed = Packed()

    def entries(places: Places, done: Collection[str]) -> Iterator[ChunkEntry]:
        for name, (split, index) in places.items():
            if name in done:
                packed.resumed += 1
            else:
                try:
                    scene = source.scenes(split)[index]
                    frames = list(encoded_frames(scene, encoding))
                    packed.frames += len(frames)
                    packed.kept += sum(kept for _, kept in frames)
                    of_frames = [frame for frame, _ in frames]
                    entry = chunk_entry(name, of_frames, scene.held_out, scene.times)
                except (ValueError, OSError) as error:
                    if not leave_out_broken:
                        raise
                    packed.left_out[name] = str(error)
                else:
                    yield entry
            progress(name)

    for split, places in splits.items():
        done, inside = journal.files[split], folder / split
        for item in inside.iterdir() if inside.is_dir() else ():
            if _is_unfinished(item):
                item.unlink()
        for chunk in _chunks(entries(places, frozenset(done)), chunk_bytes):
            file = f"{len(set(done.values())):06d}{SUFFIX}"
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


def _chunks(entries: Iterable[ChunkEntry], limit: int) -> Iterator[list[ChunkEntry]]:
    chunk: list[ChunkEntry] = []
    total = 0
    for entry in entries:
        size = sum(data.nbytes for key in ("images", "masks") for data in entry.get(key, ()))
        if chunk and total + size > limit:
            yield chunk
            chunk, total = [], 0
        chunk.append(entry)
        total += size
    if chunk:
        yield chunk


@contextmanager
def opened_replacing(path: UPath) -> Iterator[IO[bytes]]:
    """A file that replaces `path` when the block ends well; missing parent folders are made.

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
