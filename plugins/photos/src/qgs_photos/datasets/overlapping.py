"""`datasets/overlapping`: views by what the cameras see, whatever the order of the files."""

import numpy as np
from pydantic import field_validator

from qgs.contracts import Frames, OptionError, Scene, ViewSampler, ViewsConfig
from qgs.contracts.component import ComponentConfig
from qgs.data.inputs import Frusta, scene_depth, trained_ratios
from qgs.data.view_samplers import evenly, refuse_too_many, training_frames
from qgs.domain import Domain

_SHARE = 0.5
"""Share of the photos among which a sample looks for its inputs, so that a photo does not always
have the same."""
_JUDGED = 4
"""Photos on which a scene without held-out ones is judged."""


class Overlapping(ViewSampler):
    """Inputs that see most of a random photo, and overlap; it and those nearest to it are targets.

    Of photos drawn at random, inputs are those that `qgs demo` takes for the photo, .06 to .25
    depths of the scene apart, times a factor drawn log-uniformly between the bounds of `apart`. In
    evaluation the factor is 1: each held-out photo is a target, of inputs among all training
    photos; of a scene without held-out photos, four of them are. `views.gap` is not read, except
    where scenes move: those are judged in the order of time, and training refuses them.
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
        # by the names of scenes; a sweep takes a third second
        self._depths: dict[str, float] = {}

    def draw(
        self, scene: Scene, views: ViewsConfig, rng: np.random.Generator, step: int
    ) -> tuple[Frames, Frames]:
        """See `ViewSampler`. Raises ValueError for a scene that moves."""
        if scene.times is not None:
            raise ValueError(f"scene {scene.name!r} moves: set view_sampler.type to qgs/span")
        refuse_too_many(views.inputs + views.targets, scene)
        usable = _enough(scene, views.inputs + 1)
        factor = float(np.exp(rng.uniform(*np.log(self.config.apart))))
        frusta = self._frusta(scene, factor)
        target = int(rng.choice(usable))
        others = [frame for frame in usable if frame != target]
        count = max(views.inputs, round(_SHARE * len(others)))
        some = sorted(map(int, rng.choice(others, count, replace=False)))
        _, inputs = frusta.window(target, some, views.inputs)
        near = sorted({*usable} - {*inputs}, key=lambda frame: frusta.far[frame, target])
        return _ascending(inputs), tuple(near[i % len(near)] for i in range(views.targets))

    def windows(self, scene: Scene, views: ViewsConfig) -> list[tuple[Frames, Frames]]:
        """See `ViewSampler`; none where a scene moves."""
        if scene.times is not None:
            return []
        # without held-out photos the target is one of those that inputs are chosen from
        usable = _enough(scene, views.inputs if scene.held_out else views.inputs + 1)
        frusta = self._frusta(scene)
        found = list[tuple[Frames, Frames]]()
        for target in sorted(scene.held_out) or evenly(usable, _JUDGED):
            _, inputs = frusta.window(target, usable, views.inputs)
            found.append((_ascending(inputs), (target,)))
        return found

    def _frusta(self, scene: Scene, factor: float = 1.0) -> Frusta:
        """Return frusta of cameras that may stand and turn `factor` times as far apart."""
        if scene.name not in self._depths:
            self._depths[scene.name] = scene_depth(scene)
        return Frusta(scene, apart(Domain(), factor), self._depths[scene.name])


def apart(domain: Domain, factor: float) -> Domain:
    """Return `domain` with the best inputs `factor` times as far apart and turned."""
    (low, high), turn = trained_ratios(domain)
    ends = {"baseline": [factor * low, factor * high], "turn": [0.0, factor * turn]}
    return Domain({**ends, "depth": [1.0, 1.0]}, domain.samples)


def _enough(scene: Scene, least: int) -> list[int]:
    """Return the frames of training; raises ValueError for fewer than `least`."""
    usable = training_frames(scene)
    if len(usable) < least:
        besides = f" beside {len(scene.held_out)} held-out ones" if scene.held_out else ""
        raise ValueError(
            f"scene {scene.name!r} has {len(usable)} photos{besides}, and needs {least}: lower "
            "views.inputs, hold fewer out or add photos"
        )
    return usable


def _ascending(frames: Frames) -> Frames:
    return tuple(sorted(frames))
