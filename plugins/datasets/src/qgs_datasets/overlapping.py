"""`datasets/overlapping`: views by what the cameras see, whatever the order of the files."""

import numpy as np
from pydantic import field_validator

from qgs.analysis.depth import scene_depth
from qgs.analysis.inputs import Frusta
from qgs.contracts import Frames, OptionError, Scene, ViewSampler, ViewsConfig
from qgs.contracts.component import ComponentConfig
from qgs.data.domain import Domain
from qgs.data.samples import refuse_too_many, training_frames

_SHARE = 0.5
"""Of the photos, those that a sample chooses its inputs from: a photo has not always the same."""


class Overlapping(ViewSampler):
    """Inputs that see most of a random photo, and overlap; it and those nearest to it are targets.

    Of photos drawn at random, inputs are those that `qgs demo` takes for the photo, .06 to .25
    depths of the scene apart, times a factor drawn log-uniformly between the bounds of `apart`. A
    scene with held-out photos is judged on each of them, likewise with inputs of all other photos.
    `views.gap` is not read.
    """

    name = "overlapping"

    class Config(ComponentConfig):
        apart: tuple[float, float] = (0.5, 2.0)
        """Bounds of the factor in training."""

        @field_validator("apart")
        @classmethod
        def _apart_is_ordered(cls, apart: tuple[float, float]) -> tuple[float, float]:
            low, high = apart
            if not 0 < low <= high:
                raise OptionError(
                    f"must be [least, largest] with 0 < least <= largest, got [{low}, {high}]",
                    "write [0.5, 2.0], half to twice the usual distance",
                )
            return apart

    config: Config

    def __init__(self, config: Config) -> None:
        super().__init__(config)
        self._depths: dict[str, float] = {}  # by the names of scenes; a sweep takes a third second

    def draw(
        self, scene: Scene, views: ViewsConfig, rng: np.random.Generator, step: int
    ) -> tuple[Frames, Frames]:
        """See `ViewSampler`."""
        refuse_too_many(views.inputs + views.targets, scene)
        usable = training_frames(scene)
        if scene.times is not None or len(usable) <= views.inputs:
            raise ValueError(
                f"scene {scene.name!r} has {len(usable)} photos, and datasets/overlapping needs "
                f"more than {views.inputs} of one time: take qgs/span"
            )
        frusta, target = self._frusta(scene), int(rng.choice(usable))
        factor = np.exp(rng.uniform(*np.log(self.config.apart)))
        frusta.low, frusta.high = frusta.low * factor, frusta.high * factor
        frusta.most_turn *= factor
        others = [frame for frame in usable if frame != target]
        count = max(views.inputs, round(_SHARE * len(others)))
        some = sorted(map(int, rng.choice(others, count, replace=False)))
        _, inputs = frusta.window(target, some, views.inputs)
        near = sorted({*usable} - {*inputs}, key=lambda frame: frusta.far[frame, target])
        return _ascending(inputs), tuple(near[i % len(near)] for i in range(views.targets))

    def windows(self, scene: Scene, views: ViewsConfig) -> list[tuple[Frames, Frames]]:
        """See `ViewSampler`."""
        if scene.times is not None:
            return []
        frusta, usable = self._frusta(scene), training_frames(scene)
        found = {frame: frusta.window(frame, usable, views.inputs) for frame in scene.held_out}
        return [(_ascending(inputs), (frame,)) for frame, (_, inputs) in sorted(found.items())]

    def _frusta(self, scene: Scene) -> Frusta:
        if scene.name not in self._depths:
            self._depths[scene.name] = scene_depth(scene)
        return Frusta(scene, Domain(), self._depths[scene.name])


def _ascending(frames: Frames) -> Frames:
    return tuple(sorted(frames))
