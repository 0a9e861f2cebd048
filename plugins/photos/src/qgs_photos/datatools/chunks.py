"""List the scenes to check in data sets of chunks, and find faults of the chunk files."""

from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache, partial
from posixpath import join

import numpy as np
import torch
from upath import UPath

from qgs.data.photos.reader import PhotoFrame, Size
from qgs.wording import counted, listed
from qgs_photos.datasets.chunk_files import (
    INDEX,
    SUFFIX,
    Record,
    has_chunks,
    load_chunk,
    parse_record,
    read_chunk_index,
    read_mask,
    unit_problems,
)
from qgs_photos.datatools.findings import Finding, Severity
from qgs_photos.datatools.photos import Candidate, Photo, Photos

_REPACK = "pack the data set again with `qgs data pack`, or copy the file again"


def chunk_scenes(path: UPath) -> Iterator[Candidate | Finding]:
    """Yield the scenes of a data set of chunks, and faults of its files.

    path: folder with train/ and test/, folder of chunks, or one chunk.
    """
    parts = {split: path / split for split in ("train", "test") if has_chunks(path / split)}
    found = defaultdict[str, dict[str, str]](dict)
    for split, part in (parts or {"": path}).items():
        yield from _folder_scenes(split, part, found[split])
    for key in sorted(found["train"].keys() & found["test"].keys()):
        reason = "the scene is in train and in test, so that models are tested on training data"
        yield Finding(key, reason, "remove it from train or from test", severity="warning")


def _folder_scenes(
    split: str, folder: UPath, found: dict[str, str]
) -> Iterator[Candidate | Finding]:
    """Yield the scenes and faults of one folder of chunks, or of one chunk.

    found: mapping to which the file name of each scene's chunk is added, by the scene's name.
    """
    if folder.is_file():
        files = [folder]
    else:
        files = sorted((item for item in folder.iterdir() if item.suffix == SUFFIX), key=str)
    for file in files:
        yield from _file_scenes(split, file, found)
    if not (folder / INDEX).is_file():
        return
    label = join(split, INDEX)
    try:
        index = read_chunk_index(folder / INDEX)
    except (OSError, ValueError) as error:
        yield Finding(label, str(error), "write it again: a JSON mapping from scene to chunk file")
        return
    lost = defaultdict[str, list[str]](list)
    for key, name in index.items():
        if found.get(key) != name:
            lost[name].append(key)
    for name, keys in lost.items():
        missing = f"{counted(len(keys), 'scene')} that it does not hold: {listed(keys)}"
        reason = f"{INDEX} lists for this file {missing}"
        fix = f"copy the chunk again, or remove these scenes from {INDEX}"
        yield Finding(join(split, name), reason, fix)
    if unnamed := sorted(found.keys() - index.keys()):
        reason = f"the index does not name {listed(unnamed)}, so that no reader finds these scenes"
        severity: Severity = "warning" if index else "error"
        yield Finding(label, reason, "add the scenes to the index", severity=severity)


def _file_scenes(split: str, file: UPath, found: dict[str, str]) -> Iterator[Candidate | Finding]:
    label = join(split, file.name)
    try:
        entries = load_chunk(file)
    except (OSError, ValueError) as error:
        text = " ".join(str(error).replace(f"{file} ", "the file ").split())
        # without the remedy behind the last colon
        yield Finding(label, text.rpartition(": ")[0] or text, _REPACK)
        return
    scenes = 0
    for place, entry in enumerate(entries):
        key = entry.get("key") if isinstance(entry, Mapping) else None
        if isinstance(key, str) and key in found:
            reason = f"the scene in {label} is in this split twice"
            yield Finding(key, reason, f"remove one of the two scenes, or {_REPACK}")
        elif isinstance(key, str):
            found[key] = file.name
            scenes += 1
            yield Candidate(key, "chunks", partial(_photos, file, place), split)
    if scenes < len(entries) or not entries:
        reason = f"{scenes} of its {len(entries)} entries are mappings with a 'key' not used before"
        yield Finding(label, reason, _REPACK)


_entries = lru_cache(maxsize=1)(load_chunk)


def _photos(file: UPath, place: int) -> Photos:
    record = parse_record(str(file), _entries(file)[place])
    if record.sizes is None:
        # without sizes each image would be opened again to know its own
        record = replace(record, sizes=torch.tensor([_usual_size(record)] * len(record)))
    return [_photo(file, record, frame) for frame in range(len(record))], ()


def _photo(file: UPath, record: Record, frame: int) -> Photo:
    size = record.image_sizes[frame]
    try:
        c2w = np.linalg.inv(record.w2c[frame].numpy())
    # a singular matrix is told as a pose with NaN
    except np.linalg.LinAlgError:
        c2w = np.full((4, 4), np.nan)
    photo = PhotoFrame(
        name=record.names[frame],
        path=file,
        c2w=c2w,
        intrinsics=record.intrinsics(frame, size),
        size=size,
        time=None if record.times is None else float(record.times[frame]),
        problems=tuple(unit_problems(record, frame)),
    )
    return Photo(
        photo,
        lambda: record.images[frame].numpy().tobytes(),
        {"mask": lambda: read_mask(record, frame)},
    )


def _usual_size(record: Record) -> Size:
    """Return the most frequent (H, W) in the headers of images; (1, 1) if none can be read."""
    stored = Counter({(1, 1): 0})
    for frame in range(len(record)):
        with suppress(ValueError):
            stored[record.stored_size(frame)] += 1
    return stored.most_common(1)[0][0]
