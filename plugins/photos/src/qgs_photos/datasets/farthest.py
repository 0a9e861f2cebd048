"""`datasets/farthest`: DepthSplat's sampler of views."""

from collections.abc import Iterable

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from qgs.contracts import Frames, Problem, RecipeContext, Scene, ViewsConfig
from qgs.contracts.schedule import END
from qgs.data.view_samplers import one_of_each
from qgs_photos.datasets.bounded import Bounded


class Farthest(Bounded):
    """Inputs far from each other in a gap that widens over `warm_up_steps`, targets between them.

    DepthSplat's sampler `boundedv2` with `farthest_point`: two inputs are the ends of the gap, more
    are chosen one after the other, each farthest from those chosen. Of few inputs the gap is
    shorter: its bounds are divided by `views.inputs` // their number. Targets differ, and may be
    inputs; where the gap has too few frames some repeat (there: fewer targets).

    The number of inputs goes from `fewest` to `views.inputs` and again with the steps of training,
    where the release draws it: each is as frequent, and samples of a step make one batch.
    """

    name = "farthest"

    class Config(Bounded.Config):
        fewest: int = Field(default=2, ge=2)
        """Least number of inputs in training, where `views.inputs` is the largest. Evaluation has
        that one always."""

    config: Config

    @classmethod
    def problems(cls, config: Config, context: RecipeContext) -> Iterable[Problem]:
        """See `Component`."""
        yield from super().problems(config, context)
        if context.inputs and config.fewest > context.inputs:
            reason = f"it is larger than `views.inputs`, {context.inputs}"
            yield Problem("fewest", reason, "lower it, or raise `views.inputs`")

    def draw(
        self, scene: Scene, views: ViewsConfig, rng: np.random.Generator, step: int
    ) -> tuple[Frames, Frames]:
        """See `ViewSampler`."""
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
    """Choose `count` of `points` (N, 3): the one farthest from their mean, then from all chosen.

    Points that coincide with a chosen one come last, each once.
    """
    chosen = [int((points - points.mean(0)).norm(dim=-1).argmax())]
    while len(chosen) < count:
        distance = torch.cdist(points, points[chosen]).amin(-1)
        # the release can choose a point twice where all coincide
        distance[chosen] = -1
        chosen.append(int(distance.argmax()))
    return chosen
