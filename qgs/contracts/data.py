"""Contracts of the slots `data` (source of scenes) and `view_sampler` (choice of frames)."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import PositiveInt
from torch import Tensor
from upath import UPath

from qgs.contracts.component import Component, ComponentConfig
from qgs.contracts.schedule import at_step
from qgs.contracts.settings import ViewsConfig
from qgs.types import Cameras, Size
from qgs.wording import numbered

Split = Literal["train", "test"]
Frames = tuple[int, ...]
Window = tuple[Frames, Frames]
"""Indices of the input frames, and of the target frames with which renderings are compared."""


class Scene(ABC):
    """Frames of one scene: cameras and images. Images are decoded on demand.

    Frames are numbered from 0, and missing images are not counted. Options, files, tables and
    messages all use these numbers.
    """

    name: str
    held_out: Sequence[int] = ()
    """Frames that training never uses. Evaluation can use these frames as targets."""
    missing: Sequence[str] = ()
    """Names of images that the data lists but that do not exist. They get no frame number."""
    times: Tensor | None = None
    """Times (F,) of the frames, float64, in any unit. None for a static scene."""

    @property
    @abstractmethod
    def cameras(self) -> Cameras:
        """Cameras (F,) of all frames, in the coordinate frame of the data.

        Intrinsics are for images of the size that `images` returns. Poses are float64 where the
        data has that precision, because the normalisation of poses loses digits.
        """

    @abstractmethod
    def images(self, frames: Sequence[int]) -> Tensor:
        """Return images (len(frames), 3, H, W), float32 in [0, 1]."""

    def masks(self, frames: Sequence[int]) -> Tensor | None:
        """Return masks (len(frames), 1, H, W); None if the scene has none.

        A mask is 1 on the object, and 0 elsewhere.
        """
        return None

    def frame_name(self, frame: int) -> str:
        """Return a name of a frame for users: file name or time stamp, by default the number."""
        return str(frame)

    def label(self, frame: int) -> str:
        """Return the number and the name of a frame, as text for messages."""
        return numbered(frame, self.frame_name(frame))

    def stored_size(self, frame: int) -> Size | None:
        """Return (H, W) of the stored photo of `frame`; None for scenes with generated images."""
        return None

    def depths(self, frames: Sequence[int]) -> Tensor | None:
        """Return depth maps (len(frames), 1, H, W); None if the scene has none.

        Values are camera-frame z in world units, 0 where unknown.
        """
        return None

    def __len__(self) -> int:
        """Return F, the number of frames."""
        return self.cameras.shape[0]


class SceneSourceConfig(ComponentConfig):
    """Options of all data sources. A source adds the option `path`, the location of its data."""

    image_size: tuple[PositiveInt, PositiveInt] = (64, 64)
    """Size (H, W), in pixels, of all images that the source returns."""


class SceneSource(Component):
    """Source of scenes, with a training split and a test split.

    The constructor reads only what it needs to list the scenes; `Scene.images` decodes images.
    The constructor raises FileNotFoundError or ValueError; the message names the path and a fix.
    """

    slot = "data"
    not_in_protocol: ClassVar[frozenset[str]] = frozenset({"path"})
    """Options that change no scene, image or camera, such as paths and caching. They are not part
    of an evaluation protocol's hash."""
    split_options: ClassVar[frozenset[str]] = frozenset()
    """Options that only split scenes and frames into training and test. If an evaluation index
    names scenes and frames, these options are not part of the evaluation protocol's hash."""
    tells_times: ClassVar[bool] = False
    """True if scenes may have `Scene.times`. A recipe whose model reads times is refused if this is
    False."""

    class Config(SceneSourceConfig):
        """Options of this source; by default only the options that all data sources have."""

    config: SceneSourceConfig

    @classmethod
    def recognises(cls, path: UPath) -> bool:
        """Return whether file names at the existing `path` look like data of this source.

        `qgs reconstruct` and `qgs data` use this to open data without a recipe. Default: False.
        """
        return False

    @classmethod
    def trains_on(cls, root: UPath, path: UPath) -> bool:
        """Return whether the training data at `root` contains the scene at `path`.

        Both paths are absolute; they may be equal.
        """
        # Sources with scenes in files below the root override this.
        return path == root

    @classmethod
    def config_for(
        cls, path: str, image_size: Size, trained: SceneSourceConfig | None
    ) -> SceneSourceConfig:
        """Return options that open all frames at `path` for a model trained on other data.

        trained: the options of the training data, of any source; None if unknown. Options that make
        sense for `path` too are copied from `trained`.
        """
        # Only the look of photos also holds for other data.
        options: dict[str, object] = {"path": path, "image_size": image_size}
        background = getattr(trained, "background", None)
        if background is not None and "background" in cls.Config.model_fields:
            options["background"] = background
        return cls.Config.model_validate(options)

    @abstractmethod
    def scenes(self, split: Split) -> Sequence[Scene]:
        """Return the scenes of a split. Indexing the sequence must be cheap and deterministic."""

    def names(self, split: Split) -> Sequence[str]:
        """Return the names of `scenes(split)`. By default, this opens all scenes."""
        # Correct for any source, but slow if opening a scene reads files.
        return [scene.name for scene in self.scenes(split)]

    def groups(self, split: Split) -> Sequence[Sequence[int]]:
        """Return the indices of `scenes(split)`, grouped by storage, such as one group per file.

        Training visits the groups in random order, and the scenes within each group in random
        order, so that it reads each file once per epoch. Default: one group of all scenes.
        """
        return [range(len(self.scenes(split)))]


class ViewSampler(Component):
    """Sampler of the input and target frames of a scene.

    Sample number k of a training run depends only on the seed and k. So `draw` may read only its
    arguments and `config`, and all randomness must come from `rng`.
    """

    slot = "view_sampler"

    @abstractmethod
    def draw(self, scene: Scene, views: ViewsConfig, rng: np.random.Generator, step: int) -> Window:
        """Draw input frames, in ascending order, and target frames.

        All samples of a step have the same number of input frames: in evaluation at most
        `views.inputs`, in training any number.
        Held-out frames are never drawn. step: number of optimiser steps before the sample is used;
        `qgs.contracts.schedule.END` in evaluation. Raises ValueError for a scene with too few
        frames.
        """

    def windows(self, scene: Scene, views: ViewsConfig) -> list[Window]:
        """Return the windows of a scene that evaluation scores: pairs of input and target frames.

        The default is an empty list: evaluation then makes windows around held-out frames, or calls
        `draw` if there are no held-out frames.
        """
        return []

    def options(self, step: int) -> Any:
        """Return `config` with its scheduled options at their values after `step` steps."""
        return at_step(self.config, self.schedules, step)
