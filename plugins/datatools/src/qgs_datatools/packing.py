"""Any source of scenes turned into chunks, which training reads fast."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal, TypeAlias, get_args

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from upath import UPath

from qgs.contracts import Scene, SceneSource, Split
from qgs.data.chunk_files import INDEX, SUFFIX
from qgs.data.images import decode_gray, decode_rgb
from qgs.data.lenses import undistorted
from qgs.data.scenes import EncodedFrame, EncodedScene
from qgs.io.files import opened_replacing, write_bytes

_KEPT_FORMATS = {"JPEG", "MPO", "PNG"}  # MPO: a JPEG with further pictures behind it


@dataclass(frozen=True)
class Encoding:
    """How images are written that cannot stay as they are.

    resized: whether all are written at the size that their source delivers; else they keep their
    own. jpeg: quality; None for PNG, which loses nothing.
    """

    resized: bool = False
    jpeg: int | None = None

    @property
    def format(self) -> Literal["JPEG", "PNG"]:
        """The format of images that are written anew."""
        return "PNG" if self.jpeg is None else "JPEG"

    def image(self, pixels: np.ndarray) -> bytes:
        """(H, W, 3) uint8 as the bytes of a file."""
        file = io.BytesIO()
        options = {} if self.jpeg is None else {"quality": self.jpeg, "subsampling": 0}
        Image.fromarray(pixels).save(file, self.format, **options)
        return file.getvalue()


def packed_frames(scene: Scene, encoding: Encoding) -> Iterator[tuple[EncodedFrame, bool]]:
    """The frames of a scene in order, and whether each keeps its original bytes.

    Every image is decoded, so that none is packed that cannot be read. Raises as the scene does.
    """
    if isinstance(scene, EncodedScene) and not encoding.resized:
        for index in range(len(scene)):
            yield _stored(scene, index, encoding)
        return
    for index in range(len(scene)):
        yield _delivered(scene, index, encoding), False


def _stored(scene: EncodedScene, index: int, encoding: Encoding) -> tuple[EncodedFrame, bool]:
    frame = scene.encoded(index)
    place = f"scene {scene.name!r}, frame {index} ({frame.name})"
    try:
        pixels = np.array(decode_rgb(io.BytesIO(frame.data), frame.background))
        mask = None if frame.mask is None else np.array(decode_gray(io.BytesIO(frame.mask)))
    except OSError as error:
        raise ValueError(
            f"{place} cannot be read as an image ({error}): replace the file, or leave the scene "
            "out"
        ) from error
    if frame.lens is None and _stays(frame.data):
        return frame, True
    if frame.lens is not None:
        pixels = undistorted(pixels, frame.intrinsics, frame.lens)
        mask = None if mask is None else undistorted(mask, frame.intrinsics, frame.lens)
    data = encoding.image(pixels)
    return replace(frame, data=data, lens=None, mask=None if mask is None else _png(mask)), False


def _stays(data: bytes) -> bool:
    """Whether every reader of chunks gets three channels out of an image file."""
    with Image.open(io.BytesIO(data)) as image:
        plain = image.mode == "RGB" and not image.has_transparency_data
        return plain and image.format in _KEPT_FORMATS


def _delivered(scene: Scene, index: int, encoding: Encoding) -> EncodedFrame:
    cameras, masks = scene.cameras[index], scene.masks([index])
    fx, fy, cx, cy = cameras.intrinsics.double().tolist()
    pixels = scene.images([index])[0].permute(1, 2, 0).mul(255).round().byte().numpy()
    mask = None if masks is None else _png(masks[0, 0].mul(255).round().byte().numpy())
    return EncodedFrame(
        name=scene.frame_name(index),
        data=encoding.image(np.ascontiguousarray(pixels)),
        c2w=cameras.c2w.double().numpy(),
        intrinsics=(fx, fy, cx, cy),
        size=cameras.size,
        mask=mask,
    )


def _png(mask: np.ndarray) -> bytes:
    file = io.BytesIO()
    Image.fromarray(mask).save(file, "PNG")
    return file.getvalue()


JOURNAL = "packing.json"
_VERSION = 1


@dataclass
class Journal:
    """The state of a packing into `folder`.

    settings: what decides the result; another packing must not go on with it. files: of each split
    a scene's key to its chunk, for chunks that are complete.
    """

    folder: UPath
    settings: Mapping[str, Any]
    files: dict[Split, dict[str, str]] = field(default_factory=lambda: {"train": {}, "test": {}})

    def save(self) -> None:
        """Write it beside the chunks, whole or not at all."""
        content = {"version": _VERSION, "settings": self.settings, "files": self.files}
        write_bytes(self.folder / JOURNAL, json.dumps(content).encode())

    def remove(self) -> None:
        """Forget it, once all is complete."""
        (self.folder / JOURNAL).unlink()


def open_journal(folder: UPath, settings: Mapping[str, Any]) -> Journal:
    """The journal in `folder`, a new one where nothing is there yet.

    Raises FileExistsError for a folder that holds something else, and ValueError for one with an
    unfinished packing of other settings, or with a journal that is none.
    """
    settings = json.loads(json.dumps(settings))
    file = folder / JOURNAL
    if not file.is_file():
        held = _held(folder)
        if held:
            raise FileExistsError(
                f"{folder} is not empty ({', '.join(held[:5])}), and packing never overwrites: "
                "give a new folder"
            )
        return Journal(folder, settings)
    content = _read(file)
    before = content["settings"]
    other = [key for key in {**before, **settings} if before.get(key) != settings.get(key)]
    if content.get("version") != _VERSION or other:
        said = "; ".join(f"{key} was {before.get(key)}, is {settings.get(key)}" for key in other)
        raise ValueError(
            f"{folder} holds an unfinished packing with other settings ({said}): give those again "
            "to finish it, or give a new folder"
        )
    return Journal(folder, settings, content["files"])


def _read(file: UPath) -> Mapping[str, Any]:
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(_foreign(file, f"is not valid JSON ({error})")) from error
    whole = isinstance(content, dict) and isinstance(content.get("settings"), dict)
    files = content.get("files") if whole else None
    if not isinstance(files, dict) or not all(
        isinstance(files.get(s), dict) for s in get_args(Split)
    ):
        raise ValueError(_foreign(file, "was not written by a packing"))
    return content


def _foreign(file: UPath, reason: str) -> str:
    return f"{file} {reason}: move it away if you know it, or give a new folder"


def _held(folder: UPath) -> list[str]:
    """What a folder holds, but for files that a killed process was writing."""
    if not folder.is_dir():
        return []
    return sorted(item.name for item in folder.iterdir() if not is_temporary(item))


def is_temporary(path: UPath) -> bool:
    """Whether `path` is a file that `opened_replacing` was writing when its process was killed."""
    return path.name.startswith(".") and path.suffix == ".tmp"


ChunkEntry: TypeAlias = dict[str, Any]


def chunk_entry(key: str, frames: Sequence[EncodedFrame], held_out: Sequence[int]) -> ChunkEntry:
    """The entry of a scene; see `qgs.data.chunks` for its keys."""
    entry = {
        "key": key,
        "url": "",
        "timestamps": _timestamps([frame.name for frame in frames]),
        "cameras": torch.from_numpy(np.stack([_camera(frame) for frame in frames])),
        "images": [_bytes(frame.data) for frame in frames],
        "names": [frame.name for frame in frames],
        "sizes": torch.tensor([frame.size for frame in frames], dtype=torch.int32),
    }
    if any(frame.mask is not None for frame in frames):
        entry["masks"] = [_bytes(frame.mask or b"") for frame in frames]
    if held_out:
        entry["held_out"] = torch.tensor(list(held_out), dtype=torch.int64)
    return entry


def stored_bytes(entry: ChunkEntry) -> int:
    """What an entry adds to the size of its chunk, but for the container's own bytes."""
    return sum(data.nbytes for key in ("images", "masks") for data in entry.get(key, ()))


def _bytes(data: bytes) -> Tensor:
    return torch.from_numpy(np.frombuffer(data, np.uint8).copy())


def _camera(frame: EncodedFrame) -> np.ndarray:
    """(18,) float32: normalised intrinsics, two zeros, rows of the world-to-camera matrix."""
    height, width = frame.size
    fx, fy, cx, cy = frame.intrinsics
    w2c = np.linalg.inv(frame.c2w)[:3].flatten()
    values = [fx / width, fy / height, cx / width, cy / height, 0.0, 0.0, *w2c]
    return np.array(values, np.float32)


def _timestamps(names: Sequence[str]) -> Tensor:
    """The frames' names where all are whole numbers, as time stamps are; else their order."""
    numbers = names if all(_is_stamp(name) for name in names) else range(len(names))
    return torch.tensor([int(number) for number in numbers], dtype=torch.int64)


def _is_stamp(name: str) -> bool:
    return name.isascii() and name.isdigit() and len(name) < 19


@dataclass(frozen=True)
class Place:
    """Where a source holds a scene: the split and the index in it."""

    split: Split
    index: int


Places: TypeAlias = Mapping[str, Place]
"""Scenes by name."""

Splits: TypeAlias = Mapping[Split, Places]
"""What is packed into which split."""


def own_splits(source: SceneSource) -> Splits:
    """The source's own splits; scenes that are in both are packed once, for training."""
    train = _places(source, "train")
    test = {name: place for name, place in _places(source, "test").items() if name not in train}
    return {"train": train, "test": test}


def splits_by_list(source: SceneSource, test_scenes: Collection[str]) -> Splits:
    """All scenes, those named for testing. Raises ValueError for names that no scene has."""
    places = _all(source)
    absent = [name for name in test_scenes if name not in places]
    if absent:
        raise ValueError(
            f"{len(absent)} of {len(test_scenes)} test scenes are not there: {_some(absent)}; the "
            f"{len(places)} scenes are called {_some(list(places))}. Correct the list, or take "
            "them out of it"
        )
    chosen = set(test_scenes)
    return {
        "train": {name: place for name, place in places.items() if name not in chosen},
        "test": {name: place for name, place in places.items() if name in chosen},
    }


def splits_by_number(source: SceneSource, every: int) -> Splits:
    """All scenes, every n-th of them for testing, beginning with scene n - 1."""
    numbered = list(enumerate(_all(source).items()))
    return {
        "train": dict(item for i, item in numbered if i % every != every - 1),
        "test": dict(item for i, item in numbered if i % every == every - 1),
    }


def _all(source: SceneSource) -> Places:
    splits = own_splits(source)
    return {**splits["train"], **splits["test"]}


def _places(source: SceneSource, split: Split) -> dict[str, Place]:
    places: dict[str, Place] = {}
    for index, name in enumerate(source.names(split)):
        if name in places:
            raise ValueError(
                f"two scenes are called {name!r}, and chunks tell scenes by their names: rename one"
            )
        places[name] = Place(split, index)
    return places


def _some(names: list[str]) -> str:
    return ", ".join(names[:5]) + (", ..." if len(names) > 5 else "")


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
                self._add(name, source, place)
            progress(name)
        self._flush()

    def _add(self, name: str, source: SceneSource, place: Place) -> None:
        try:
            entry = self._entry(name, source.scenes(place.split)[place.index])
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
