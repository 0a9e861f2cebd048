"""Convert any source of scenes to chunks, which training reads fast."""

import json
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import IO, Any

import torch
from upath import UPath

from qgs.contracts import SceneSource, Split
from qgs.files import is_leftover, replacing
from qgs.paths import is_local, listing, read_json
from qgs.wording import listed
from qgs_photos.datasets.chunk_files import INDEX, SUFFIX, load_chunk
from qgs_photos.datatools.entries import ChunkEntry, Encoding, chunk_entry, encoded_frames

SETTINGS = "packing.json"
"""File in the output folder with the settings of the packing; deleted when it is finished."""

Places = Mapping[str, tuple[Split, int]]
"""Scenes by name: the scene's split in the source, and the scene's index in this split."""

# What is packed into which split.
Splits = Mapping[Split, Places]


def chosen_splits(
    source: SceneSource, test: Collection[str] | None = None, every: int | None = None
) -> Splits:
    """Divide the scenes of `source` into train and test.

    test: names of the test scenes. every: N, to make every Nth of all scenes a test scene,
    beginning with index N - 1. If both are None, the splits of the source are kept, and a scene in
    both splits is packed only for training. Raises ValueError if a name in `test` is not a scene.
    """
    train = _places(source, "train")
    # train comes first for the order, and last because it wins for a scene in both splits
    places = {**train, **_places(source, "test"), **train}
    if test is not None:
        if absent := [name for name in test if name not in places]:
            raise ValueError(
                f"{len(absent)} of {len(test)} test scenes do not exist: {listed(absent)}; the "
                f"{len(places)} scenes are {listed(places)}. Correct the names in the list, or "
                "remove them"
            )
        wanted = {*test}
    elif every is not None:
        wanted = {*[*places][every - 1 :: every]}
    else:
        wanted = places.keys() - train.keys()
    chosen = {name: places.pop(name) for name in [*places] if name in wanted}
    return {"train": places, "test": chosen}


def _places(source: SceneSource, split: Split) -> dict[str, tuple[Split, int]]:
    places: dict[str, tuple[Split, int]] = {}
    for index, name in enumerate(source.names(split)):
        if name in places:
            raise ValueError(
                f"two scenes are called {name!r}, but chunks identify scenes by name: rename one"
            )
        places[name] = split, index
    return places


def _begin(folder: UPath, settings: Mapping[str, Any]) -> None:
    """Begin a packing in `folder`, or continue an unfinished one with the same settings.

    Raises ValueError if the unfinished packing has other settings, and FileExistsError if the
    folder holds anything else.
    """
    # tuples become lists, or settings would differ from those read from the file
    settings = json.loads(json.dumps(settings))
    file = folder / SETTINGS
    if file.is_file():
        before = read_json(file, "move this file away, or give a new folder")
        if before != settings:
            raise ValueError(
                f"{folder} holds an unfinished packing with other settings ({before}): repeat "
                "these settings to finish that packing, or give a new folder"
            )
        return
    held = [item.name for item in listing(folder) if not is_leftover(item)]  # type: ignore[arg-type]
    if held:
        raise FileExistsError(
            f"{folder} is not empty ({listed(sorted(held))}), and packing never overwrites: "
            "give a new folder"
        )
    write_bytes(file, json.dumps(settings).encode())


def _packed_before(folder: UPath) -> dict[str, str]:
    """Return the chunk file of each packed scene by the scene's name; delete unfinished files."""
    files: dict[str, str] = {}
    for item in sorted(listing(folder), key=str):
        if is_leftover(item):  # type: ignore[arg-type]
            item.unlink()
        elif item.suffix == SUFFIX:
            files |= {entry["key"]: item.name for entry in load_chunk(item)}
    return files


@dataclass
class Packed:
    """Result of `pack`.

    scenes: number of scenes by split. resumed: how many of these scenes an earlier, interrupted run
    had packed. frames: images written in this run. kept: how many of these images were copied
    unchanged. left_out: names of scenes that cannot be read, with the reason.
    """

    scenes: dict[Split, int] = field(default_factory=dict)
    resumed: int = 0
    frames: int = 0
    kept: int = 0
    left_out: dict[str, str] = field(default_factory=dict)

    def told(self, out: str) -> Iterator[str]:
        """Yield lines for the user on what was packed into `out`."""
        scenes = ", ".join(f"{count} {split}" for split, count in self.scenes.items())
        again = f", {self.resumed} of them by an earlier run" if self.resumed else ""
        yield (
            f"{out}: packed scenes: {scenes}{again}; images of this run: {self.frames}, of which "
            f"{self.kept} copied unchanged and {self.frames - self.kept} encoded again"
        )
        if not self.scenes["test"]:
            yield "there are no test scenes: evaluations will use held-out photos of scenes"
        if self.left_out:
            yield f"scenes left out since they cannot be read: {len(self.left_out)}"
        for name, reason in self.left_out.items():
            yield f"  {name}: {reason}"


def pack(
    source: SceneSource,
    splits: Splits,
    folder: UPath,
    settings: Mapping[str, Any],
    encoding: Encoding | None = None,
    *,
    chunk_bytes: int = 100 * 2**20,
    leave_out_broken: bool = False,
    progress: Callable[[str], None] = lambda scene: None,
) -> Packed:
    """Write the scenes of `splits` to `folder` as chunks.

    A chunk has at most `chunk_bytes` bytes, or holds one larger scene. index.json is written last.
    An interrupted packing continues after its last complete chunk if its settings are the same.

    settings: options, beside those of the source, on which `splits` depend. leave_out_broken: leave
    out scenes that cannot be read and name them in the result; False raises the error. progress:
    called with the name of each finished scene. Raises FileExistsError for a folder with other
    content, ValueError for an unfinished packing with other settings, and the errors of reading
    scenes.
    """
    # chunks of two settings in one folder would be a data set that nobody asked for
    encoding = encoding or Encoding()
    options = {"source": type(source).name, **source.config.model_dump(mode="json"), **settings}
    _begin(folder, {**options, **asdict(encoding), "chunk_bytes": chunk_bytes})
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

    written: dict[Split, dict[str, str]] = {}
    for split, places in splits.items():
        files = written[split] = _packed_before(folder / split)
        for chunk in _chunks(entries(places, files), chunk_bytes):
            # numbers go on after the chunks of an interrupted run
            file = f"{len({*files.values()}):06d}{SUFFIX}"
            with opened_replacing(folder / split / file) as opened:
                torch.save(chunk, opened)
            files |= {entry["key"]: file for entry in chunk}
    if not any(written.values()):
        reasons = listed((f"{n}: {why}" for n, why in packed.left_out.items()), 3, "; ")
        raise ValueError(f"there is no scene to pack{': ' if reasons else ''}{reasons}")
    for split, files in written.items():
        packed.scenes[split] = len(files)
        if files:
            write_bytes(folder / split / INDEX, json.dumps(files, indent=1).encode())
    (folder / SETTINGS).unlink()
    return packed


def _entry(name: str, scene: Any, encoding: Encoding, packed: Packed) -> ChunkEntry:
    frames = [*encoded_frames(scene, encoding)]
    packed.frames += len(frames)
    packed.kept += sum(frame.kept for frame in frames)
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
    """Open a file that replaces `path` if the `with` block ends without an error.

    Missing parent folders are made. On a local disk the replacement is atomic; other file systems
    show a file only when it is complete.
    """
    if is_local(path):
        with replacing(Path(str(path))) as temporary, temporary.open("wb") as file:
            yield file
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.fs.transaction, path.open("wb") as file:
        yield file


def write_bytes(path: UPath, data: bytes) -> None:
    """Write `data` to `path` completely or not at all."""
    with opened_replacing(path) as file:
        file.write(data)
