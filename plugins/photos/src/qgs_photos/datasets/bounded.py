"""`datasets/bounded`: pixelSplat's sampler of views."""

from collections.abc import Iterable, Sequence

import numpy as np
from pydantic import Field

from qgs.contracts import Frames, Problem, RecipeContext, Scene, ViewSampler, ViewsConfig
from qgs.contracts.component import ComponentConfig
from qgs.data.view_samplers import moments, one_of_each, refuse_too_many


class Bounded(ViewSampler):
    """Inputs at both ends of a gap that widens over `warm_up_steps`, targets between them.

    pixelSplat's sampler of this name for two inputs; further inputs are drawn between the ends.
    The published code limits the largest gap by the least one on paths that do not close; here the
    number of frames limits it. Targets may repeat. `views.gap` is read for windows around held-out
    frames alone.
    """

    name = "bounded"
    scheduled = frozenset({"min_gap", "max_gap", "margin"})

    class Config(ComponentConfig):
        min_gap: int = Field(default=45, ge=1)
        """Least number of frames from the first input to the last, after the warm-up."""
        max_gap: int = Field(default=192, ge=1)
        """Largest number, after the warm-up; a scene may allow less."""
        margin: int = Field(default=0, ge=0)
        """Frames from a target to the first and the last input, at least."""
        warm_up_steps: int = Field(default=150_000, ge=0)
        """Optimiser steps in which the gap goes from its initial bounds to the final ones."""
        initial_min_gap: int = Field(default=25, ge=1)
        """Least gap in the first step."""
        initial_max_gap: int = Field(default=45, ge=1)
        """Largest gap in the first step."""

    config: Config

    @classmethod
    def problems(cls, config: Config, context: RecipeContext) -> Iterable[Problem]:
        """See `Component`."""
        if context.inputs == 1:
            yield Problem("", "it needs two inputs, and `views.inputs` is 1", "take qgs/span")
        for low, high in (("min_gap", "max_gap"), ("initial_min_gap", "initial_max_gap")):
            if getattr(config, low) > getattr(config, high):
                yield Problem(low, f"it is larger than `{high}`", f"raise `{high}`")

    def draw(
        self, scene: Scene, views: ViewsConfig, rng: np.random.Generator, step: int
    ) -> tuple[Frames, Frames]:
        """See `ViewSampler`."""
        span = self.span(scene, views, rng, step)
        between = rng.choice(range(1, len(span) - 1), views.inputs - 2, replace=False)
        places = [0, *sorted(map(int, between)), len(span) - 1]
        inputs = one_of_each([span[place] for place in places], range(len(places)))
        pool = self.seen(scene, span, rng, step)
        return inputs, tuple(map(int, rng.choice(pool, views.targets)))

    def span(
        self, scene: Scene, views: ViewsConfig, rng: np.random.Generator, step: int, parts: int = 1
    ) -> list[Frames]:
        """Return the moments that are drawn from, first to last; gaps are divided by `parts`."""
        refuse_too_many(views.inputs + views.targets, scene)
        options = self.options(step)
        usable = moments(scene)
        low, high = (gap // parts for gap in self.gaps(step))
        high = min(high, len(usable) - 1)
        # a target needs a place at the margin from both ends, and each input one of its own
        low = max(min(low, high), 2 * options.margin, views.inputs - 1)
        if high < low:
            raise ValueError(
                f"scene {scene.name!r} has {len(usable)} frames for inputs, and {low + 1} are "
                "needed for this gap: lower min_gap or margin, or drop the scene"
            )
        gap = int(rng.integers(low, high + 1))
        first = int(rng.integers(0, len(usable) - gap))
        return usable[first : first + gap + 1]

    def seen(
        self, scene: Scene, span: Sequence[Frames], rng: np.random.Generator, step: int
    ) -> list[int]:
        """Return the frames of a span that targets are drawn from."""
        margin = self.options(step).margin
        inside = span[margin : len(span) - margin]
        # all targets of a sample are of one moment
        if scene.times is not None:
            inside = [inside[int(rng.integers(len(inside)))]]
        return [frame for moment in inside for frame in moment]

    def gaps(self, step: int) -> tuple[int, int]:
        """Return the least and largest gap after `step` steps: linear between the bounds."""
        options = self.options(step)
        share = min(step / options.warm_up_steps, 1.0) if options.warm_up_steps else 1.0
        bounds = (
            (options.initial_min_gap, options.min_gap),
            (options.initial_max_gap, options.max_gap),
        )
        low, high = (start + int((end - start) * share) for start, end in bounds)
        return low, high
