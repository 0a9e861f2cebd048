"""Slots `data` and `view_sampler`: where scenes come from, and which of their frames to use."""

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
    """Frames of one scene, decoded only when asked for.

    A frame's number is its place, from 0, among those that are there: indices, held-out lists,
    options, tables and messages all mean this number.
    """

    name: str
    held_out: Sequence[int] = ()
    """Frames that training never sees, so that evaluation can target them."""
    missing: Sequence[str] = ()
    """Images that are listed and do not exist; they are no frames, so later ones move up."""
    times: Tensor | None = None
    """Times (F,) at which frames were taken, float64, in any unit; None where nothing moves."""

    @property
    @abstractmethod
    def cameras(self) -> Cameras:
        """Cameras (F,) of all frames at the delivered image size, in the scene's own frame.

        Poses are float64 where the data has that precision: normalising them loses digits.
        """

    @abstractmethod
    def images(self, frames: Sequence[int]) -> Tensor:
        """Images (len(frames), 3, H, W) float32 in [0, 1]."""

    def masks(self, frames: Sequence[int]) -> Tensor | None:
        """Masks (len(frames), 1, H, W) in [0, 1], 1 on what is to be modelled; None without."""
        return None

    def frame_name(self, frame: int) -> str:
        """The name by which a person knows a frame: a file name or a time stamp."""
        return str(frame)

    def label(self, frame: int) -> str:
        """Number and name of a frame, for messages."""
        return numbered(frame, self.frame_name(frame))

    def stored_size(self, frame: int) -> tuple[int, int] | None:
        """(H, W) of the photo before it is delivered; None where images are made to measure."""
        return None

    def depths(self, frames: Sequence[int]) -> Tensor | None:
        """Camera-frame z (len(frames), 1, H, W), world units, 0 where unknown; None without."""
        return None

    def __len__(self) -> int:
        """F, the number of frames."""
        return self.cameras.shape[0]


class SceneSourceConfig(ComponentConfig):
    """Options of all sources. Where a source's data lies is its option `path`."""

    image_size: tuple[Side, Side] = (64, 64)
    """(H, W) of every delivered image, in pixels."""


class SceneSource(Component):
    """A collection of scenes with a training and a test split.

    Opening a source reads what it needs to list its scenes and raises FileNotFoundError or
    ValueError with the path and the remedy; images are decoded by `Scene.images`.
    """

    slot: ClassVar[str] = "data"
    not_in_protocol: ClassVar[frozenset[str]] = frozenset({"path"})
    """Options that change no scene, image or camera: where files lie, how they are kept in memory.
    Hashes of evaluation protocols leave them out."""
    split_options: ClassVar[frozenset[str]] = frozenset()
    """Options that only choose which scenes and frames are trained on, and which are judged. Where
    an evaluation index names these, hashes of protocols leave them out too."""
    tells_times: ClassVar[bool] = False
    """Whether scenes may have `Scene.times`; models that read times are refused beside others."""

    class Config(SceneSourceConfig):
        """The common settings."""

    config: SceneSourceConfig

    @classmethod
    def recognises(cls, path: UPath) -> bool:
        """Return whether the existing `path` looks like data of this source, by its names of files.

        So that `qgs reconstruct` and `qgs data` open it without a recipe. By default no path does.
        """
        return False

    @classmethod
    def trains_on(cls, root: UPath, path: UPath) -> bool:
        """Return whether training data at `root` is `path` or has it as a scene, both absolute."""
        # Sources whose scenes are files below the root say more.
        return path == root

    @classmethod
    def config_for(
        cls, path: str, image_size: tuple[int, int], trained: SceneSourceConfig | None
    ) -> SceneSourceConfig:
        """Options that open all frames of `path` for a model that was trained on other data.

        trained: options of that data, of any source; what goes for `path` too is taken over.
        """
        # Of the trained data, only how photos look goes for others as well.
        options: dict[str, object] = {"path": path, "image_size": image_size}
        background = getattr(trained, "background", None)
        if background is not None and "background" in cls.Config.model_fields:
            options["background"] = background
        return cls.Config.model_validate(options)

    @abstractmethod
    def scenes(self, split: Split) -> Sequence[Scene]:
        """The scenes of a split; indexing is cheap and deterministic."""

    def names(self, split: Split) -> Sequence[str]:
        """The name of every scene of `scenes(split)`; sources that know them open no scene."""
        # Correct for any source, and slow where opening a scene reads files.
        return [scene.name for scene in self.scenes(split)]

    def groups(self, split: Split) -> Sequence[Sequence[int]]:
        """Indices of `scenes(split)` by where they are stored, such as one group per file.

        Training visits groups in random order, and the scenes of a group one after another in
        random order, so that a file is read once an epoch. One group shuffles everything.
        """
        return [range(len(self.scenes(split)))]


class ViewSampler(Component):
    """Which frames of a scene are the inputs and the targets of a sample.

    Sample k of a training is a function of (seed, k): `draw` reads nothing but its arguments and
    `config`, and all chance comes from `rng`.
    """

    slot: ClassVar[str] = "view_sampler"

    @abstractmethod
    def draw(
        self, scene: Scene, views: ViewsConfig, rng: np.random.Generator, step: int
    ) -> tuple[Frames, Frames]:
        """Up to `views.inputs` frames, ascending, as many in each sample of a step, and targets.

        Held-out frames are never drawn. step: optimiser steps before the one that the sample is
        for; `qgs.contracts.schedule.END` in evaluation. Raises ValueError for too few frames.
        """

    def windows(self, scene: Scene, views: ViewsConfig) -> list[tuple[Frames, Frames]]:
        """Input and target frames of each window that a scene is judged on.

        Empty by default: then `EvaluationPlan` has windows in the order of frames.
        """
        return []

    def options(self, step: int) -> Any:
        """`config` with the numbers of scheduled options after `step` steps."""
        return at_step(self.config, self.schedules, step)
