"""`globalsplat/two_passes`: two predictions of one scene, from different photos, should agree."""

from collections.abc import Iterable

from pydantic import Field
from torch import Tensor

from qgs.contracts import (
    ComponentConfig,
    Objective,
    Outcome,
    Passes,
    Problem,
    RecipeContext,
)
from qgs.geometry.precision import full_precision
from qgs.types import Rendering, Views

LEAST_VIEWS = 3
FIX = "raise views.inputs, or choose `objective: {type: qgs/one_pass}`"


class TwoPasses(Objective):
    """Two predictions, each from every other inner view and both end views, judged and compared.

    Their renderings from the target cameras are compared in alpha and depth; each is pulled to the
    other one, which stands still meanwhile.
    """

    name = "two_passes"
    scheduled = frozenset({"alpha_weight", "depth_weight"})

    class Config(ComponentConfig):
        """Defaults are GlobalSplat's."""

        alpha_weight: float = Field(default=1e-3, ge=0)
        """Factor of the difference of the alphas."""
        depth_weight: float = Field(default=1e-2, ge=0)
        """Factor of the difference of the depths, world units."""

    config: Config

    @classmethod
    def problems(cls, config: ComponentConfig, context: RecipeContext) -> Iterable[Problem]:
        """Fewer input views than two different passes need."""
        if context.inputs is not None and context.inputs < LEAST_VIEWS:
            yield Problem("", _too_few(context.inputs), FIX)

    def forward(self, inputs: Views, targets: Views, passes: Passes) -> Outcome:
        """Adds the terms `alpha_consistency` and `depth_consistency`.

        Raises ValueError for fewer than 3 input views: both passes would see the same ones.
        """
        count = inputs.images.shape[1]
        if count < LEAST_VIEWS:
            raise ValueError(f"{_too_few(count)}; {FIX}")
        outcomes = list[Outcome]()
        renderings = list[Rendering]()
        for part in (0, 1):
            some = inputs.select(subset(count, part))
            prediction = passes.predict(some)
            outcomes.append(passes.judge(prediction, targets, some))
            # Both are drawn from the target cameras, which neither pass has seen.
            renderings.append(passes.render(prediction.gaussians, targets.cameras))
        one, other = renderings
        return Outcome.mean(
            outcomes,
            alpha_consistency=self.config.alpha_weight * disagreement(one.alpha, other.alpha),
            depth_consistency=self.config.depth_weight * disagreement(one.depth, other.depth),
        )


def _too_few(count: int) -> str:
    return (
        f"the objective globalsplat/two_passes needs at least {LEAST_VIEWS} input views, got "
        f"{count}: its passes share the first and the last, and would both be the same"
    )


def subset(count: int, part: int) -> list[int]:
    """The first and the last of `count` views, and every other one between them."""
    return [0, *range(1 + part, count - 1, 2), count - 1]


@full_precision
def disagreement(one: Tensor, other: Tensor) -> Tensor:
    """Mean |one - other|, 0-d; each side gets half of the gradient, with the other one held.

    The symmetric stop-gradient of the paper, averaged; a sum would give the whole gradient.
    """
    # Without holding one side both would drift to the blurred mean.
    held = (one - other.detach()).abs().mean(), (other - one.detach()).abs().mean()
    return (held[0] + held[1]) / 2
