"""The endless sequence of training samples, made one by one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from qgs.contracts import Scene, SceneSource, ViewsConfig
from qgs.data.order import SceneOrder
from qgs.data.sampling import Batch, Frames, Sample, collate, draw_frames, make_sample


class SampleError(ValueError):
    """A training sample that cannot be made; the message names the scene and the frame."""


class SampleStream:
    """Training samples of `source` by number; sample k depends on (seed, k) alone.

    Raises ValueError when the source has no training scenes.
    """

    def __init__(self, source: SceneSource, views: ViewsConfig, seed: int) -> None:
        self._scenes = source.scenes("train")
        if not len(self._scenes):
            raise ValueError(f"the data source {type(source).name!r} has no training scenes")
        self.order = SceneOrder(source.groups("train"), len(self._scenes), seed)
        self._views, self._seed = views, seed

    def batch(self, numbers: Sequence[int]) -> Batch:
        """The samples of these numbers, counted from 0 over all epochs.

        Raises ValueError for a scene with too few frames, SampleError for frames that cannot be
        decoded or normalised.
        """
        return collate([self._sample(number) for number in numbers])

    def _sample(self, number: int) -> Sample:
        rng = np.random.default_rng([self._seed, 1, number])
        scene = self._scenes[self.order.scene(number)]
        mirror = bool(rng.random() < self._views.mirror)
        inputs, targets = draw_frames(scene, self._views, rng)
        try:
            return make_sample(scene, inputs, targets, self._views, mirror)
        except Exception as error:
            raise SampleError(_told(scene, (*inputs, *targets), error)) from error


def _told(scene: Scene, frames: Frames, error: Exception) -> str:
    """What went wrong with which frames of `scene`: the first that fails alone, else all."""
    for frame in frames:
        try:
            scene.images([frame])
            scene.masks([frame])
        except Exception as own:
            return f"scene {scene.name!r}, frame {frame} ({scene.frame_name(frame)}): {own}"
    return f"scene {scene.name!r}, frames {sorted(set(frames))}: {error}"
