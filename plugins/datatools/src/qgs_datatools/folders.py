"""Scenes, chunks and evaluation indices of a data set as candidates for a check."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from typing import Any

import numpy as np
import torch
from upath import UPath

from qgs.data.chunk_files import (
    INDEX,
    SUFFIX,
    Record,
    a_type,
    has_chunks,
    load_chunk,
    parse_record,
    read_chunk_index,
    unit_problems,
)
from qgs.data.dl3dv import Place, find_scenes, scene_folder
from qgs.data.evaluation import GIVEN, IndexEntry, read_index
from qgs.data.lenses import Size
from qgs.data.photos import READERS, Format, formats_of, read_listing
from qgs.data.photos.reader import PhotoFrame, existing
from qgs.data.photos.source import folder_name
from qgs_datatools.conventions import LLFF, OPENCV, OPENGL
from qgs_datatools.findings import Candidate, Finding, Photo, spans
from qgs_datatools.sources import kind_of

_POSES = {"opengl": OPENGL, "opencv": OPENCV, "llff": LLFF}
_CONVENTIONS = {reader.name: _POSES[reader.poses] for reader in READERS}


def photo_folder(
    folder: UPath, name: str, wanted: Format, images: str | None
) -> Iterator[Candidate]:
    """A candidate for each of the listings that a folder holds, or for the wanted one."""
    held = [kind for kind in formats_of(folder) if wanted in ("auto", kind)]
    for kind in held:
        label = f"{name} ({kind})" if len(held) > 1 else name
        photos = partial(_listed, folder, kind, images)
        yield Candidate(label, name, kind, _CONVENTIONS[kind], photos)


def photo_folders(root: UPath, wanted: Format, images: str | None) -> Iterator[Candidate | Finding]:
    """The scenes in `root`, which may be one itself, or hold them in train and test."""
    if formats_of(root):
        yield from photo_folder(root, folder_name(root), wanted, images)
        return
    inside = sorted((item for item in root.iterdir() if item.is_dir()), key=lambda item: item.name)
    scenes = {item.name: item for item in inside if formats_of(item)}
    for name, folder in scenes.items():
        yield from photo_folder(folder, name, wanted, images)
    for folder in inside:
        if folder.name in scenes or folder.name.startswith("."):
            continue
        if not scenes and folder.name in ("train", "test"):
            yield from photo_folders(folder, wanted, images)
        elif scenes:
            yield _no_scene(folder)


def _no_scene(folder: UPath) -> Finding:
    kind = kind_of(folder)
    if kind != "photos":
        reason = f"the folder is another data set ({kind}) and is not checked with the photos"
        return Finding(
            folder.name, f"{reason} beside it", f"run `qgs data check {folder}`", severity="warning"
        )
    reason = "the folder lists no cameras and is no scene"
    return Finding(folder.name, reason, "make poses for it, or move it away", severity="warning")


def dl3dv_scenes(path: UPath, images: str | None) -> list[Candidate]:
    """The scenes below `path`. Raises FileNotFoundError when there is none."""
    return [
        Candidate(name, name, "dl3dv", OPENGL, partial(_in_place, place, images))
        for name, place in find_scenes(path).items()
    ]


def _in_place(place: Place, images: str | None) -> list[Photo]:
    return _listed(scene_folder(place), "nerfstudio", images)


def _listed(folder: UPath, kind: Format, images: str | None) -> list[Photo]:
    return _with_files(read_listing(folder, kind, images).frames)


def _with_files(frames: Sequence[PhotoFrame]) -> list[Photo]:
    there = existing(frame.path for frame in frames if frame.name)
    masks = existing(frame.mask for frame in frames if frame.mask is not None)
    return [
        Photo(
            frame, frame.path.read_bytes, frame.path in there,
            frame.mask is None or frame.mask == frame.path or frame.mask in masks,
        )
        for frame in frames
    ]  # fmt: skip


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
        folder.index = read_chunk_index(folder.folder / INDEX)
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
    return f"; {INDEX} places there {_listed_of_chunk_files(keys)}" if keys else ""


def _listed_of_chunk_files(keys: Sequence[str]) -> str:
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
        f"the chunk does not exist; {INDEX} places there {_listed_of_chunk_files(keys)}",
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
            problems=tuple(unit_problems(record, frame)),
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


@dataclass(frozen=True)
class Held:
    """A scene that is there. split: empty where the format has none. frames: None if unreadable."""

    split: str
    frames: int | None


@dataclass(frozen=True)
class IndexSummary:
    """An index in numbers. null: scenes that it lists without frames, which are never judged."""

    file: str
    scenes: int
    null: int

    def __str__(self) -> str:
        return f"{self.file}: {self.scenes} scenes, {self.null} of them without frames (null)"


def found_indices(path: UPath) -> list[UPath]:
    """The JSON files in the folder `path` that have the form of an evaluation index."""
    if not path.is_dir():
        return []
    files = sorted((item for item in path.iterdir() if item.suffix == ".json"), key=str)
    return [file for file in files if _is_index(file)]


def _is_index(file: UPath) -> bool:
    try:
        data = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(data, dict) and any(
        isinstance(entry, dict) and {"context", "target"} <= entry.keys() for entry in data.values()
    )


def index_findings(
    file: UPath, scenes: Mapping[str, Sequence[Held]], told: Container[str] = ()
) -> tuple[list[Finding], IndexSummary | None]:
    """What the index names and is not there, less scenes whose absence is `told` already.

    The summary is None for a file that is no index. Raises FileNotFoundError without a file.
    """
    try:
        index = read_index(str(file))
    except ValueError as error:
        fix = "correct the file, or get it again"
        return [Finding(str(file.name), str(error), fix)], None
    findings: list[Finding] = []
    for name, entry in index.items():
        if entry is not None and (name in scenes or name not in told):
            findings += _entry_findings(file.name, name, entry, scenes.get(name, ()))
    null = sum(entry is None for entry in index.values())
    return findings, IndexSummary(str(file), len(index), null)


def _entry_findings(
    file: str, name: str, entry: IndexEntry, held: Sequence[Held]
) -> Iterator[Finding]:
    if not held:
        fix = "add the scene, or take it out of the index; correct the name if it is spelled wrong"
        yield Finding(name, f"the index {file} names the scene, which is not there", fix)
        return
    of_test = [scene for scene in held if scene.split != "train"]
    if not of_test:
        fix = "move it to the test split, or take it out of the index"
        yield Finding(name, f"the index {file} names the scene, which is in train only", fix)
    frames = (of_test or held)[0].frames
    if frames is None:
        return
    for role, numbers in (("context", entry.context), ("target", entry.target)):
        outside = [number for number in numbers if not 0 <= number < frames]
        if outside:
            yield Finding(
                name,
                f"the index {file} has the {role} frame{'s' if len(outside) > 1 else ''} "
                f"{spans(outside)}, but the scene's {frames} frames are 0 to {frames - 1}",
                "correct the index, or add the missing frames to the scene",
                tuple(outside),
            )
    if entry.both:
        yield Finding(
            name,
            f"the index {file} has {GIVEN}",
            "judge models on frames that they are not given",
            entry.both,
            severity="warning",
        )
