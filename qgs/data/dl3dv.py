"""`qgs/dl3dv`: DL3DV's scenes, from archives or folders."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from typing import ClassVar, TypeAlias, cast

from pydantic import Field
from torch import Tensor
from upath import UPath

from qgs.contracts import Scene, SceneSource, Split
from qgs.data.lazy import LazyScenes
from qgs.data.paths import ArchivePath, opened_path
from qgs.data.photos.scene import Development, EncodedFrame, EncodedScene, PhotoScene, pixel_cache
from qgs.data.photos.source import held_out_frames, present_frames
from qgs.types import Cameras


def read_scene_list(file: UPath) -> list[str]:
    """Names of scenes in a file: the keys of a JSON mapping, such as an evaluation index, a JSON
    list of names, or lines of text, where what follows # is a comment.

    Raises FileNotFoundError, and ValueError for a file that names no scene.
    """
    try:
        text = file.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise FileNotFoundError(f"the list of scenes {file} does not exist") from None
    if file.suffix == ".json":
        names = _from_json(file, text)
    else:
        lines = (line.partition("#")[0].strip() for line in text.splitlines())
        names = [line for line in lines if line]
    if not names:
        raise ValueError(f"the list of scenes {file} names no scene: write one on each line")
    return list(dict.fromkeys(names))


def _from_json(file: UPath, text: str) -> list[str]:
    try:
        data = json.loads(text)
    except json.JSONDecodeError as error:
        raise ValueError(f"{file} is not valid JSON ({error})") from error
    if not isinstance(data, dict | list) or not all(isinstance(name, str) for name in data):
        raise ValueError(
            f"{file} must be a mapping whose keys are scenes, or a list of scenes, in JSON"
        )
    return list(data)


_log = logging.getLogger(__name__)

LISTING = "transforms.json"
_INSIDE = ("", "gaussian_splat", "nerfstudio")
_DEPTH = 2  # folders between the data set's and a scene

Place: TypeAlias = UPath | ArchivePath
"""An archive's top or a folder: what a scene is published as."""


def find_scenes(path: UPath) -> dict[str, Place]:
    """The scenes below `path` by name, sorted; archives are not opened.

    `path` may be a scene itself. A scene that is there as a folder and as an archive is read from
    the folder; such scenes are counted and named in a warning. Raises FileNotFoundError when there
    is none.
    """
    if not path.exists():
        raise FileNotFoundError(
            f"the DL3DV folder {path} does not exist: give the folder that holds 1K/, {{hash}}.zip "
            "or {hash}/"
        )
    scenes: dict[str, Place] = {}
    again: set[str] = set()
    for name, place in sorted(_places(path, _DEPTH), key=lambda item: (item[0], str(item[1]))):
        if name in scenes:
            again.add(name)
        if name not in scenes or isinstance(scenes[name], ArchivePath):
            scenes[name] = place
    if not scenes:
        inside = ", ".join(sorted(item.name for item in path.iterdir())[:8]) or "nothing"
        raise FileNotFoundError(
            f"{path} holds no scenes of DL3DV: expected {{hash}}.zip or {{hash}}/{LISTING}, also "
            f"in folders such as 1K/, found {inside}"
        )
    if again:
        _log.warning(
            "%d scenes of %s are there more than once, as folders or archives; one of each is "
            "read: %s", len(again), path, ", ".join(f"{n} ({scenes[n]})" for n in sorted(again)),
        )  # fmt: skip
    return scenes


def _places(path: UPath, depth: int) -> Iterator[tuple[str, Place]]:
    if path.suffix == ".zip" and path.is_file():
        yield path.stem, ArchivePath(path)
    elif not path.is_dir():
        return
    elif _holds_listing(path):
        yield path.name, path
    elif depth:
        for item in path.iterdir():
            if not item.name.startswith("."):
                yield from _places(item, depth - 1)


def _holds_listing(folder: UPath) -> bool:
    return any((folder / inside / LISTING).is_file() for inside in _INSIDE)


def scene_folder(place: Place) -> UPath:
    """The folder of a scene that holds transforms.json.

    Raises FileNotFoundError when there is none, ValueError when an archive holds several scenes or
    cannot be read.
    """
    tops: list[Place] = [place]
    if isinstance(place, ArchivePath):
        tops += [item for item in place.iterdir() if item.is_dir() and item.name not in _INSIDE]
    found = [top for top in tops if _within(top)]
    if not found:
        raise FileNotFoundError(
            f"{place} holds no {LISTING}, at its top or in gaussian_splat/ or nerfstudio/: "
            "download the scene again, or remove it"
        )
    if len(found) > 1:
        raise ValueError(
            f"{place} holds {len(found)} scenes, {found[0].name} and {found[1].name} among them, "
            "and one is expected in an archive: unpack it, and give the folder"
        )
    return cast(UPath, _within(found[0])[0])


def _within(top: Place) -> list[Place]:
    folders = [top / inside if inside else top for inside in _INSIDE]
    return [folder for folder in folders if (folder / LISTING).is_file()]


class Dl3dvConfig(SceneSource.Config):
    """Options of `qgs/dl3dv`.

    path: folder or fsspec URL of the data set, of a subset or of one scene, relative to the working
    directory. images: folder of photos to read, such as images_4; the least reduced one of a scene
    by default. test_scenes: file that names the scenes of the test split, whose other scenes are
    for training: an evaluation index, a JSON list or lines of text. holdout: every n-th frame of
    each scene is kept for evaluation, from frame n // 2 on; 0 for none. max_scenes: only the first
    scenes of each split by name, 0 for all. background: RGB behind transparent pixels.
    """

    undecisive: ClassVar[frozenset[str]] = SceneSource.Config.undecisive | {
        "test_scenes",
        "max_scenes",
    }
    split_options: ClassVar[frozenset[str]] = frozenset({"holdout"})

    path: str
    images: str | None = None
    test_scenes: str | None = None
    holdout: int = Field(default=0, ge=0)
    max_scenes: int = Field(default=0, ge=0)
    background: tuple[float, float, float] = (1.0, 1.0, 1.0)


class Dl3dvScenes(LazyScenes):
    """The scenes of a split, each read when it is asked for."""

    def __init__(self, places: Mapping[str, Place], config: Dl3dvConfig) -> None:
        self._places, self._config = list(places.items()), config

    def __len__(self) -> int:
        return len(self._places)

    def scene(self, place: int) -> Dl3dvScene:
        """See `LazyScenes`."""
        return Dl3dvScene(*self._places[place], self._config)


class Dl3dvScene(EncodedScene):
    """A scene that is opened when more than its name is asked for; see `open_scene`."""

    def __init__(self, name: str, place: Place, config: Dl3dvConfig) -> None:
        self.name = name
        self._place, self._config = place, config

    @cached_property
    def _photos(self) -> PhotoScene:
        return open_scene(self.name, self._place, self._config)

    def __len__(self) -> int:
        return len(self._photos)

    @property
    def held_out(self) -> Sequence[int]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """See `Scene`."""
        return self._photos.held_out

    @property
    def missing(self) -> Sequence[str]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """See `Scene`."""
        return self._photos.missing

    @property
    def cameras(self) -> Cameras:
        """See `Scene`; float64."""
        return self._photos.cameras

    def images(self, frames: Sequence[int]) -> Tensor:
        """See `Scene`. Raises ValueError for a file that cannot be decoded."""
        return self._photos.images(frames)

    def masks(self, frames: Sequence[int]) -> Tensor | None:
        """See `Scene`."""
        return self._photos.masks(frames)

    def frame_name(self, frame: int) -> str:
        """See `Scene`: the image file, relative to the folder of transforms.json."""
        return self._photos.frame_name(frame)

    def encoded(self, frame: int) -> EncodedFrame:
        """See `EncodedScene`."""
        return self._photos.encoded(frame)


def open_scene(name: str, place: Place, config: Dl3dvConfig) -> PhotoScene:
    """A scene of DL3DV; images that do not exist are left out, counted and named in a warning.

    Intrinsics are those of transforms.json, for images of its `w` and `h`, scaled to the size that
    the folder of photos has. Raises FileNotFoundError and ValueError, with what to do, for a scene
    without photos or with poses or intrinsics that cannot be meant.
    """
    frames, missing = present_frames(scene_folder(place), "nerfstudio", config.images)
    development = Development(config.image_size, config.background)
    held_out = held_out_frames(frames, config.holdout)
    scene = PhotoScene(name, frames, development, held_out, pixel_cache(0))
    scene.missing = missing
    return scene


class Dl3dvSource(SceneSource):
    """Scenes of DL3DV, read in place: archives are not unpacked.

    Without `test_scenes` all scenes are for training, and are evaluated on their held-out frames if
    `holdout` asks for any.

    absent: scenes that `test_scenes` names and that are not there, which are counted and named in a
    warning.
    """

    name = "dl3dv"
    Config = Dl3dvConfig

    def __init__(self, config: Dl3dvConfig) -> None:
        super().__init__(config)
        places = find_scenes(opened_path(config.path))
        self.absent: list[str] = []
        if config.test_scenes is None:
            train = _scenes(places, config)
            test = train if config.holdout else _scenes({}, config)
        else:
            listed = read_scene_list(opened_path(config.test_scenes))
            self.absent = [name for name in listed if name not in places]
            self._tell_absent(len(listed))
            chosen = {name: places[name] for name in listed if name in places}
            train = _scenes({n: p for n, p in places.items() if n not in chosen}, config)
            test = _scenes(chosen, config)
        self._splits: dict[Split, Dl3dvScenes] = {"train": train, "test": test}

    def _tell_absent(self, listed: int) -> None:
        if self.absent:
            _log.warning(
                "%d of %d test scenes are not there: %s",
                len(self.absent), listed, ", ".join(self.absent),
            )  # fmt: skip

    def scenes(self, split: Split) -> Sequence[Scene]:
        """See `SceneSource`."""
        return self._splits[split]


def _scenes(places: Mapping[str, Place], config: Dl3dvConfig) -> Dl3dvScenes:
    return Dl3dvScenes(dict(list(places.items())[: config.max_scenes or None]), config)
