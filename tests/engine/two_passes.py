"""A plugin with an objective of two passes, as GlobalSplat's: facts of its paper, no code of it."""

from typing import ClassVar

from pydantic import Field
from torch import Tensor

import qgs
from qgs.contracts import ComponentConfig, Objective, Outcome, Passes
from qgs.types import Rendering, Views


class TwoPasses(Objective):
    """Two predictions, each from every other inner view and both end views, that must agree.

    Both are judged; alpha and depth of their renderings are compared, each as if the other were
    given.
    """

    name: ClassVar[str] = "two_passes"
    scheduled: ClassVar[frozenset[str]] = frozenset({"alpha_weight", "depth_weight"})

    class Config(ComponentConfig):
        alpha_weight: float = Field(default=1e-3, ge=0)
        """Factor of the difference of the two alphas."""
        depth_weight: float = Field(default=1e-2, ge=0)
        """Factor of the difference of the two depths."""

    config: Config

    def forward(self, inputs: Views, targets: Views, passes: Passes) -> Outcome:
        outcomes, renderings = list[Outcome](), list[Rendering]()
        for part in (0, 1):
            some = inputs.select(subset(inputs.images.shape[1], part))
            prediction = passes.predict(some)
            outcomes.append(passes.judge(prediction, targets, some))
            renderings.append(passes.render(prediction.gaussians, targets.cameras))
        alphas, depths = ([getattr(r, n) for r in renderings] for n in ("alpha", "depth"))
        return Outcome.mean(
            outcomes,
            alpha_consistency=self.config.alpha_weight * disagreement(*alphas),
            depth_consistency=self.config.depth_weight * disagreement(*depths),
        )


def subset(count: int, part: int) -> list[int]:
    """The first and the last of `count` views, and every other one between them."""
    return [0, *range(1 + part, count - 1, 2), count - 1]


def disagreement(one: Tensor, other: Tensor) -> Tensor:
    """Mean absolute difference, half of its gradient to each side, which sees the other fixed."""
    return ((one - other.detach()).abs().mean() + (other - one.detach()).abs().mean()) / 2


plugin = qgs.Plugin("two", qgs.CONTRACT_VERSION, (TwoPasses,))
