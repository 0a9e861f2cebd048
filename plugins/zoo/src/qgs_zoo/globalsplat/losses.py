"""`globalsplat/frustum`, `globalsplat/regularisers`: Gaussians in sight, few, small.

`globalsplat/two_passes`: two predictions of one scene, from different photos, should agree.
"""

import math
from collections.abc import Iterable

import torch
import torch.nn.functional as F
from pydantic import Field
from torch import Tensor

from qgs.contracts import (
    ComponentConfig,
    Loss,
    Objective,
    Outcome,
    Passes,
    Problem,
    RecipeContext,
)
from qgs.geometry.transforms import to_camera
from qgs.losses import mean_of_gaussians
from qgs.precision import full_precision
from qgs.types import Cameras, LayerPrediction, Rendering, Views
from qgs_zoo.parts import mean_outcome


class Frustum(Loss):
    """Mean over Gaussians of `beyond_frusta` of the input cameras."""

    name = "frustum"
    renderings = "none"

    class Config(Loss.Config):
        weight: float = Field(default=0.01, ge=0)
        """Factor of the term in the objective."""
        softness: float = Field(default=0.05, gt=0)
        """Distance to a border of a view within which it is felt, world units."""
        near: float = Field(default=0.05, ge=0)
        """Camera-frame z of the near plane, world units."""

    config: Config

    def term(
        self, prediction: LayerPrediction, rendering: Rendering, target: Views, inputs: Views
    ) -> Tensor:
        options = self.config.softness, self.config.near
        per_point = beyond_frusta(prediction.gaussians.means, inputs.cameras, *options)
        return mean_of_gaussians(per_point, prediction)


class Regularisers(Loss):
    """Mean opacity and mean scale (as in Kheradmand et al. 2024, 3DGS as MCMC)."""

    name = "regularisers"
    scheduled = frozenset({"weight", "opacity_weight", "scale_weight"})
    renderings = "none"

    class Config(Loss.Config):
        opacity_weight: float = Field(default=0.01, ge=0)
        """Factor of the mean opacity."""
        scale_weight: float = Field(default=0.01, ge=0)
        """Factor of the mean scale, world units."""

    config: Config

    def term(
        self, prediction: LayerPrediction, rendering: Rendering, target: Views, inputs: Views
    ) -> dict[str, Tensor]:
        """Terms `mean_opacity`, `mean_scale`."""
        gaussians = prediction.gaussians
        # Means, not sums: the number of Gaussians changes with the level.
        opacity = mean_of_gaussians(gaussians.opacities, prediction)
        scale = mean_of_gaussians(gaussians.scales.mean(-1), prediction)
        return {
            "mean_opacity": self.config.opacity_weight * opacity,
            "mean_scale": self.config.scale_weight * scale,
        }


@full_precision
def beyond_frusta(points: Tensor, cameras: Cameras, softness: float, near: float) -> Tensor:
    """How far points (B, P, 3) are outside of all views, (B, P), world units, smooth, at least 0.

    A view is five half-spaces, its four borders and the near plane. Per view, softplus of the
    distance beyond each, added up; then the soft minimum over views, -t log mean exp(-x / t). It
    has a gradient everywhere, behind a camera too, and divides by no depth.
    """
    x, y, z = to_camera(points, cameras).unbind(-1)
    fx, fy, cx, cy = cameras.intrinsics[..., None, :].unbind(-1)
    height, width = cameras.size
    # Signed distances to planes through the camera's centre, so that nothing is divided by depth.
    borders = [(x, fx, cx), (-x, fx, width - cx), (y, fy, cy), (-y, fy, height - cy)]
    inside = [(focal * side + c * z) / torch.hypot(focal, c) for side, focal, c in borders]
    depths = torch.stack([*inside, z - near])  # positive inside
    beyond_BVP = F.softplus(-depths / softness).sum(0)
    views = math.log(cameras.shape[1])
    return softness * (views - torch.logsumexp(-beyond_BVP, 1))


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
            reason = (
                f"it needs at least {LEAST_VIEWS} input views, got {context.inputs}: its passes "
                "share the first and the last, and would both be the same"
            )
            yield Problem("", reason, FIX)

    def forward(self, inputs: Views, targets: Views, passes: Passes) -> Outcome:
        """Adds the terms `alpha_consistency` and `depth_consistency`."""
        count = inputs.images.shape[1]
        outcomes = list[Outcome]()
        renderings = list[Rendering]()
        for part in (0, 1):
            some = inputs.select(subset(count, part))
            prediction = passes.predict(some)
            outcomes.append(passes.judge(prediction, targets, some))
            # Both are drawn from the target cameras, which neither pass has seen.
            renderings.append(passes.render(prediction.gaussians, targets.cameras))
        one, other = renderings
        return mean_outcome(
            outcomes,
            alpha_consistency=self.config.alpha_weight * disagreement(one.alpha, other.alpha),
            depth_consistency=self.config.depth_weight * disagreement(one.depth, other.depth),
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
