"""View samplers: pixelSplat's, DepthSplat's, and one for photos in any order."""

from collections.abc import Iterable, Sequence

import numpy as np
import torch
from pydantic import Field, NonNegativeInt, PositiveInt
from torch import Tensor

from qgs.contracts import (
    Ascending,
    ComponentConfig,
    Frames,
    Problem,
    RecipeContext,
    Scene,
    ViewSampler,
    ViewsConfig,
    Window,
)
from qgs.contracts.schedule import END
from qgs.data.inputs import Frusta, scene_depth, trained_ratios
from qgs.data.view_samplers import evenly, moments, one_of_each, refuse_too_many, training_frames
from qgs.domain import Domain

_SHARE = 0.5
"""Fraction of the photos that are candidates for the inputs of a training sample. Each sample
chooses its candidates at random."""
_JUDGED = 4
"""Number of photos on which a scene without held-out photos is evaluated."""


class Bounded(ViewSampler):
    """Sampler of inputs at both ends of a random gap in a video, and of targets between them.

    The gap is the number of frames from the first to the last input; it widens over
    `warm_up_steps`. For two inputs this is pixelSplat's sampler `bounded`; further inputs are
    sampled between the ends. If the camera path is no closed loop, pixelSplat uses the least gap
    as the largest gap; here only the number of frames limits the gap. Targets may repeat.
    `views.gap` is used only for evaluation windows around held-out frames.
    """

    name = "bounded"
    scheduled = frozenset({"min_gap", "max_gap", "margin"})

    class Config(ComponentConfig):
        min_gap: PositiveInt = 45
        """Least number of frames from the first input to the last, after the warm-up."""
        max_gap: PositiveInt = 192
        """Largest number of frames from the first input to the last, after the warm-up. In shorter
        scenes the number of frames is the limit."""
        margin: NonNegativeInt = 0
        """Least distance in frames of a target from the first and the last input. 0: an input may
        be a target."""
        warm_up_steps: NonNegativeInt = 150_000
        """Optimiser steps in which the bounds of the gap go from their initial to their final
        values. 0: no warm-up."""
        initial_min_gap: PositiveInt = 25
        """Least number of frames from the first input to the last, in the first step."""
        initial_max_gap: PositiveInt = 45
        """Largest number of frames from the first input to the last, in the first step."""

    config: Config

    @classmethod
    def problems(cls, config: Config, context: RecipeContext) -> Iterable[Problem]:
        """Yield a problem for a single input, and for a least gap that is above the largest."""
        if context.inputs == 1:
            yield Problem("", "it needs two inputs, but `views.inputs` is 1", "take qgs/span")
        for low, high in (("min_gap", "max_gap"), ("initial_min_gap", "initial_max_gap")):
            if getattr(config, low) > getattr(config, high):
                yield Problem(low, f"it is larger than `{high}`", f"raise `{high}`")

    def draw(self, scene: Scene, views: ViewsConfig, rng: np.random.Generator, step: int) -> Window:
        """Return random input frames, in ascending order, and target frames from the gap.

        step: number of optimiser steps before the sample is used, or END in evaluation. The bounds
        of the gap depend on `step`. Raises ValueError for a scene with too few frames.
        """
        span = self.span(scene, views, rng, step)
        between = rng.choice(range(1, len(span) - 1), views.inputs - 2, replace=False)
        places = [0, *sorted(map(int, between)), len(span) - 1]
        inputs = one_of_each([span[place] for place in places], range(len(places)))
        return inputs, tuple(map(int, rng.choice(self.seen(scene, span, rng, step), views.targets)))

    def span(
        self, scene: Scene, views: ViewsConfig, rng: np.random.Generator, step: int, parts: int = 1
    ) -> list[Frames]:
        """Return the frames of a random stretch of the video, as one tuple of frames per time.

        A tuple has several frames if several cameras took photos at that time. The length of the
        stretch is random between the bounds that `gaps` returns, divided by `parts`. Raises
        ValueError for a scene with too few frames.
        """
        refuse_too_many(views.inputs + views.targets, scene)
        options = self.options(step)
        usable = moments(scene)
        low, high = (gap // parts for gap in self.gaps(step))
        high = min(high, len(usable) - 1)
        # a target needs a place at the margin from both ends, and each input one of its own
        low = max(min(low, high), 2 * options.margin, views.inputs - 1)
        if high < low:
            raise ValueError(
                f"a sample of scene {scene.name!r} must span {low + 1} frames for its inputs and "
                f"margins; max_gap or the scene ({len(usable)} frames for inputs) allows fewer: "
                "lower views.inputs or margin, raise max_gap, or remove the scene"
            )
        gap = int(rng.integers(low, high + 1))
        first = int(rng.integers(0, len(usable) - gap))
        return usable[first : first + gap + 1]

    def seen(
        self, scene: Scene, span: Sequence[Frames], rng: np.random.Generator, step: int
    ) -> list[int]:
        """Return the frames to sample targets from: `span` without `margin` times at each end.

        In a scene that moves, returns only the frames of one of these times, chosen at random.
        """
        margin = self.options(step).margin
        inside = span[margin : len(span) - margin]
        # all targets of a sample are of one moment
        if scene.times is not None:
            inside = [inside[int(rng.integers(len(inside)))]]
        return [frame for moment in inside for frame in moment]

    def gaps(self, step: int) -> tuple[int, ...]:
        """Return the least and the largest gap, in frames, after `step` training steps.

        During the warm-up both bounds change linearly.
        """
        options = self.options(step)
        share = min(step / options.warm_up_steps, 1.0) if options.warm_up_steps else 1.0
        bounds = (
            (options.initial_min_gap, options.min_gap),
            (options.initial_max_gap, options.max_gap),
        )
        return tuple(start + int((end - start) * share) for start, end in bounds)


class Farthest(Bounded):
    """Sampler of inputs far from each other in a random stretch of a video, and targets in it.

    The length of the stretch, the gap, grows over `warm_up_steps`. This is DepthSplat's sampler
    `boundedv2` with `farthest_point`. Two inputs are the ends of the stretch. More inputs are
    chosen one after another, each as far as possible from those already chosen. If the number
    n of inputs is below `views.inputs`, the bounds of the gap are divided by `views.inputs` // n.
    Targets may be inputs. Targets repeat only if the stretch has too few frames (DepthSplat then
    returns fewer targets).

    In training, n is `fewest` in the first step, grows by one per step up to `views.inputs`, and
    then starts again. DepthSplat chooses n at random. Both make every n equally frequent; here all
    samples of a step have the same n, so that they can form one batch.
    """

    name = "farthest"

    class Config(Bounded.Config):
        fewest: int = Field(default=2, ge=2)
        """Least number of inputs in training; `views.inputs` is the largest. Evaluation always uses
        `views.inputs`."""

    config: Config

    @classmethod
    def problems(cls, config: Config, context: RecipeContext) -> Iterable[Problem]:
        """Yield the problems that `Bounded` finds, and one if `fewest` is above `views.inputs`."""
        yield from super().problems(config, context)
        if context.inputs and config.fewest > context.inputs:
            reason = f"it is larger than `views.inputs`, {context.inputs}"
            yield Problem("fewest", reason, "lower `fewest`, or raise `views.inputs`")

    def draw(self, scene: Scene, views: ViewsConfig, rng: np.random.Generator, step: int) -> Window:
        """Return input frames that are far apart, in ascending order, and target frames.

        step: number of optimiser steps before the sample is used, on which the gap and the number
        of inputs depend; END in evaluation. Raises ValueError for a scene with too few frames.
        """
        most = views.inputs
        fewest = self.config.fewest
        count = most if step == END else fewest + step % (most - fewest + 1)
        views = views.model_copy(update={"inputs": count})
        span = self.span(scene, views, rng, step, parts=most // count)
        places = [0, len(span) - 1]
        if count > 2:
            centres = scene.cameras.c2w[[moment[0] for moment in span], :3, 3]
            places = sorted(farthest_points(centres, count))
        inputs = one_of_each([span[place] for place in places], range(count))
        pool = self.seen(scene, span, rng, step)
        targets = [*rng.permutation(pool), *rng.choice(pool, max(views.targets - len(pool), 0))]
        return inputs, tuple(map(int, targets[: views.targets]))


def farthest_points(points: Tensor, count: int) -> list[int]:
    """Choose `count` of the points (N, 3) that are far from each other, and return their indices.

    The first point is farthest from the mean of all; each further point is farthest from those
    chosen before. Points equal to a chosen point come last. No index is returned twice.
    """
    chosen = [int((points - points.mean(0)).norm(dim=-1).argmax())]
    while len(chosen) < count:
        distance = torch.cdist(points, points[chosen]).amin(-1)
        # the release can choose a point twice where all coincide
        distance[chosen] = -1
        chosen.append(int(distance.argmax()))
    return chosen


class Overlapping(ViewSampler):
    """Sampler for photos in any order: overlapping inputs around a random photo.

    The inputs are those that `qgs demo` would choose for the random photo. Their baselines are .06
    to .25 of the scene's depth, times a random factor, log-uniform between the bounds of `apart`.
    Targets are the random photo and the photos nearest to it. In evaluation the factor is 1, and
    each held-out photo is a target; a scene without held-out photos has four targets. For a
    scene that moves, training is refused, and evaluation uses windows in the order of time whose
    length is given by `views.gap`.
    """

    name = "overlapping"

    class Config(ComponentConfig):
        apart: Ascending = (0.5, 2.0)
        """[least, largest] factor of the distances and angles between inputs in training, relative
        to the inputs that `qgs demo` chooses. [1, 1] chooses as `qgs demo` does."""

    config: Config

    def __init__(self, config: Config) -> None:
        super().__init__(config)
        # by the names of scenes; a sweep takes a third second
        self._depths: dict[str, float] = {}

    def draw(self, scene: Scene, views: ViewsConfig, rng: np.random.Generator, step: int) -> Window:
        """Return overlapping input frames, in ascending order, and target frames near them.

        step: has no effect. Raises ValueError for a scene that moves or has too few photos.
        """
        if scene.times is not None:
            raise ValueError(
                f"scene {scene.name!r} moves, but this view sampler trains on static scenes: set "
                "view_sampler.type to qgs/span"
            )
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
        return tuple(sorted(inputs)), tuple(near[i % len(near)] for i in range(views.targets))

    def windows(self, scene: Scene, views: ViewsConfig) -> list[Window]:
        """Return inputs and target of each evaluation window, one window for each target photo.

        Returns [] for a scene with times. Evaluation then chooses windows by `views.gap`.
        """
        if scene.times is not None:
            return []
        # without held-out photos the target is one of those that inputs are chosen from
        usable = _enough(scene, views.inputs if scene.held_out else views.inputs + 1)
        frusta = self._frusta(scene)
        targets = sorted(scene.held_out) or evenly(usable, _JUDGED)
        windows = list[Window]()
        for target in targets:
            _, inputs = frusta.window(target, usable, views.inputs)
            windows.append((tuple(sorted(inputs)), (target,)))
        return windows

    def _frusta(self, scene: Scene, factor: float = 1.0) -> Frusta:
        """Return the view frusta of a scene's cameras, from which inputs are chosen.

        factor: multiplies the distances and the angles between inputs.
        """
        if scene.name not in self._depths:
            self._depths[scene.name] = scene_depth(scene)
        return Frusta(scene, apart(Domain(), factor), self._depths[scene.name])


def apart(domain: Domain, factor: float) -> Domain:
    """Return `domain` with its ranges of baselines and angles of inputs multiplied by `factor`."""
    low, high, turn = trained_ratios(domain)
    ends = {"baseline": [factor * low, factor * high], "turn": [0.0, factor * turn]}
    return Domain({**ends, "depth": [1.0, 1.0]}, domain.samples)


def _enough(scene: Scene, least: int) -> list[int]:
    """Return the training frames of a scene. Raises ValueError if there are fewer than `least`."""
    usable = training_frames(scene)
    if len(usable) < least:
        besides = f" beside {len(scene.held_out)} held-out ones" if scene.held_out else ""
        raise ValueError(
            f"scene {scene.name!r} has {len(usable)} photos{besides}, but a sample needs {least}: "
            "lower views.inputs, hold out fewer photos, or add photos"
        )
    return usable
