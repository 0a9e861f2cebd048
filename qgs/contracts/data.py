"""Contracts of the slots `data` (the source of scenes) and `view_sampler` (the frames to use)."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Annotated, Any, ClassVar, Literal, TypeAlias

import numpy as np
from pydantic import Field
from torch import Tensor
from upath import UPath

from qgs.contracts.component import Component, ComponentConfig
from qgs.contracts.schedule import at_step
from qgs.contracts.settings import ViewsConfig
from qgs.types import Cameras
from qgs.wording import numbered

Split = Literal["train", "test"]
Frames: TypeAlias = tuple[int, ...]
Side: TypeAlias = Annotated[int, Field(ge=1)]


class Scene(ABC):
    """The frames of one scene; images are decoded on demand.

    Frames are numbered from 0, and missing images are not counted. Indices, held-out lists,
    options, tables and messages all use this number.
    """

    name: str
    held_out: Sequence[int] = ()
    """Frames that training never sees. Evaluation can use them as targets."""
    missing: Sequence[str] = ()
    """Listed images that do not exist. They do not count as frames, so later frames move up."""
    times: Tensor | None = None
    """Times (F,) of the frames, float64, in any unit. None for a static scene."""

    @property
    @abstractmethod
    def cameras(self) -> Cameras:
        """Cameras (F,) of all frames, for the delivered image size, in the scene's own frame.

        Poses are float64 where the data has that precision, because normalising loses digits.
        """

    @abstractmethod
    def images(self, frames: Sequence[int]) -> Tensor:
        """Return images (len(frames), 3, H, W), float32 in [0, 1]."""

    def masks(self, frames: Sequence[int]) -> Tensor | None:
        """Return masks (len(frames), 1, H, W) in [0, 1], 1 on the object; None without masks."""
        return None

    def frame_name(self, frame: int) -> str:
        """Return the name under which a user knows a frame: a file name or a time stamp."""
        return str(frame)

    def label(self, frame: int) -> str:
        """Return number and name of a frame, for messages."""
        return numbered(frame, self.frame_name(frame))

    def stored_size(self, frame: int) -> tuple[int, int] | None:
        """Return (H, W) of the photo as stored; None if images are made at the delivered size."""
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
    """Options of all sources. A source adds the option `path`, the location of its data."""

    image_size: tuple[Side, Side] = (64, 64)
    """(H, W) of every delivered image, in pixels."""


class SceneSource(Component):
    """A collection of scenes with a training and a test split.

    Opening a source reads only what it needs to list its scenes. It raises FileNotFoundError or
    ValueError, whose message names the path and a fix. `Scene.images` decodes images.
    """

    slot: ClassVar[str] = "data"
    not_in_protocol: ClassVar[frozenset[str]] = frozenset({"path"})
    """Options that change no scene, image or camera, such as paths and caching. Hashes of
    evaluation protocols leave them out."""
    split_options: ClassVar[frozenset[str]] = frozenset()
    """Options that only split scenes and frames into training and test. If an evaluation index
    names scenes and frames, hashes of protocols leave these options out too."""
    tells_times: ClassVar[bool] = False
    """True if scenes may have `Scene.times`. A model that reads times needs such a source; a recipe
    with another one is refused."""

    class Config(SceneSourceConfig):
        """Options of this source; by default only the common ones."""

    config: SceneSourceConfig

    @classmethod
    def recognises(cls, path: UPath) -> bool:
        """Return whether the existing `path` looks like data of this source, judged by file names.

        `qgs reconstruct` and `qgs data` use this to open data without a recipe. Default: False.
        """
        return False

    @classmethod
    def trains_on(cls, root: UPath, path: UPath) -> bool:
        """Return whether training data at `root` is or contains `path`, a scene; both absolute."""
        # Sources with scenes in files below the root override this.
        return path == root

    @classmethod
    def config_for(
        cls, path: str, image_size: tuple[int, int], trained: SceneSourceConfig | None
    ) -> SceneSourceConfig:
        """Return options that open all frames of `path` for a model trained on other data.

        trained: the options of the training data, of any source. Options that also hold for `path`
        are copied from it.
        """
        # Only the look of photos also holds for other data.
        options: dict[str, object] = {"path": path, "image_size": image_size}
        background = getattr(trained, "background", None)
        if background is not None and "background" in cls.Config.model_fields:
            options["background"] = background
        return cls.Config.model_validate(options)

    @abstractmethod
    def scenes(self, split: Split) -> Sequence[Scene]:
        """Return the scenes of a split; indexing must be cheap and deterministic."""

    def names(self, split: Split) -> Sequence[str]:
        """Return the names of `scenes(split)`; override it to avoid opening the scenes."""
        # Correct for any source, but slow if opening a scene reads files.
        return [scene.name for scene in self.scenes(split)]

    def groups(self, split: Split) -> Sequence[Sequence[int]]:
        """Return the indices of `scenes(split)`, grouped by storage, such as one group per file.

        Training visits groups in random order, and then the scenes of each group in random order,
        so that it reads a file once per epoch. A single group shuffles all scenes together.
        """
        return [range(len(self.scenes(split)))]


class ViewSampler(Component):
    """Sampler of the input and target frames of a scene.

    Sample k of a training run is a function of (seed, k). So `draw` may read only its arguments
    and `config`, and all randomness must come from `rng`.
    """

    slot: ClassVar[str] = "view_sampler"

    @abstractmethod
    def draw(
        self, scene: Scene, views: ViewsConfig, rng: np.random.Generator, step: int
    ) -> tuple[Frames, Frames]:
        """Draw input frames, ascending, and target frames; raise ValueError for too few frames.

        There are at most `views.inputs` inputs, equally many in all samples of a step. Held-out
        frames are never drawn. step: number of optimiser steps before the sample is used;
        `qgs.contracts.schedule.END` in evaluation.
        """

    def windows(self, scene: Scene, views: ViewsConfig) -> list[tuple[Frames, Frames]]:
        """Return the input and target frames of each window that evaluation scores in a scene.

        The default is empty: `EvaluationPlan` then chooses windows in the order of frames.
        """
        return []

    def options(self, step: int) -> Any:
        """Return `config` with the values of scheduled options after `step` steps."""
        return at_step(self.config, self.schedules, step)
