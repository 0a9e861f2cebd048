"""Samplers of views: which frames of a scene a training sample shows."""

from collections.abc import Iterable

import numpy as np
from pydantic import Field

from qgs.contracts import Frames, Problem, RecipeContext, Scene, ViewSampler, ViewsConfig
from qgs.contracts.component import ComponentConfig
from qgs.data.frames import draw_frames


class Span(ViewSampler):
    """Inputs at both ends of a random span and within it, targets from the span (TokenGS release).

    The span has min_gap to max_gap frames from its first to its last. See `draw_frames`.
    """

    name = "span"
    scheduled = frozenset({"min_gap", "max_gap"})

    class Config(ComponentConfig):
        min_gap: int | None = Field(default=None, ge=1)
        """Least gap; null for that of `views.gap`."""
        max_gap: int | None = Field(default=None, ge=1)
        """Largest gap; null for that of `views.gap`. A schedule lets it grow with training."""

    config: Config

    @classmethod
    def problems(cls, config: Config, context: RecipeContext) -> Iterable[Problem]:
        """See `Component`."""
        if config.min_gap and config.max_gap and config.min_gap > config.max_gap:
            yield Problem("min_gap", "it is larger than `max_gap`", "raise `max_gap`")

    def draw(
        self, scene: Scene, views: ViewsConfig, rng: np.random.Generator, step: int
    ) -> tuple[Frames, Frames]:
        """See `ViewSampler`."""
        options = self.options(step)
        high = options.max_gap or views.gap[1]
        # A schedule may bring the largest gap below the least one of the recipe.
        low = min(options.min_gap or views.gap[0], high)
        return draw_frames(scene, views.model_copy(update={"gap": (low, high)}), rng)
