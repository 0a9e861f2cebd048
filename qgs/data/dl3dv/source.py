"""`qgs/dl3dv`: DL3DV's scenes, from archives or folders."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import ClassVar

from pydantic import Field
from torch import Tensor

from qgs.contracts import Scene, SceneSource, Split
from qgs.data.dl3dv.layout import Place, find_scenes, scene_folder
from qgs.data.encoded import EncodedFrame, EncodedScene
from qgs.data.lazy_scenes import LazyScenes
from qgs.data.paths import opened_path
from qgs.data.photo_scene import Development, PhotoScene, pixel_cache
from qgs.data.photos import held_out_frames, present_frames
from qgs.data.scene_lists import read_scene_list
from qgs.types import Cameras

_log = logging.getLogger(__name__)


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
