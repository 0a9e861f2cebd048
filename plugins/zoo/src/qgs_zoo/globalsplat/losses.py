"""`globalsplat/frustum`, `globalsplat/regularisers`: losses for visible, few and small Gaussians.

`globalsplat/two_passes`: objective by which predictions from different photos should agree.
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
    """Mean of `beyond_frusta` over Gaussians, with the frusta of the input cameras."""

    name = "frustum"
    renderings = "none"

    class Config(Loss.Config):
        weight: float = Field(default=0.01, ge=0)
        """Weight of the loss in the objective."""
        softness: float = Field(default=0.05, gt=0)
        """Distance from a border of a view at which the loss starts to act, world units."""
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
    """Mean opacity and mean scale as losses (Kheradmand et al. 2024, 3DGS as MCMC)."""

    name = "regularisers"
    scheduled = frozenset({"weight", "opacity_weight", "scale_weight"})
    renderings = "none"

    class Config(Loss.Config):
        opacity_weight: float = Field(default=0.01, ge=0)
        """Weight of the mean opacity."""
        scale_weight: float = Field(default=0.01, ge=0)
        """Weight of the mean scale, world units."""

    config: Config

    def term(
        self, prediction: LayerPrediction, rendering: Rendering, target: Views, inputs: Views
    ) -> dict[str, Tensor]:
        """Return the terms `mean_opacity` and `mean_scale`."""
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
    """Return the smooth distances (B, P) >= 0 of points (B, P, 3) from all views, world units.

    A view is the intersection of five half-spaces: four borders and the near plane. Each view sums
    the softplus of the distance beyond each. The result is the soft minimum over views,
    -t log mean exp(-x / t). It has a gradient everywhere, also behind a camera, and never divides
    by a depth.
    """
    x, y, z = to_camera(points, cameras).unbind(-1)
    fx, fy, cx, cy = cameras.intrinsics[..., None, :].unbind(-1)
    height, width = cameras.size
    # Signed distances to planes through the camera's centre: no division by depth.
    borders = [(x, fx, cx), (-x, fx, width - cx), (y, fy, cy), (-y, fy, height - cy)]
    inside = [(focal * side + c * z) / torch.hypot(focal, c) for side, focal, c in borders]
    depths = torch.stack([*inside, z - near])  # positive inside
    beyond_BVP = F.softplus(-depths / softness).sum(0)
    views = math.log(cameras.shape[1])
    return softness * (views - torch.logsumexp(-beyond_BVP, 1))


LEAST_VIEWS = 3
FIX = "raise views.inputs, or choose `objective: {type: qgs/one_pass}`"


class TwoPasses(Objective):
    """Objective of two predictions, each from both end views and every other view between them.

    Both get the recipe's losses. Their renderings from the target cameras are also compared in
    alpha and depth. Each is pulled towards the other, which is held fixed.
    """

    name = "two_passes"
    scheduled = frozenset({"alpha_weight", "depth_weight"})

    class Config(ComponentConfig):
        """Options with GlobalSplat's defaults."""

        alpha_weight: float = Field(default=1e-3, ge=0)
        """Weight of the difference of the alphas."""
        depth_weight: float = Field(default=1e-2, ge=0)
        """Weight of the difference of the depths, world units."""

    config: Config

    @classmethod
    def problems(cls, config: ComponentConfig, context: RecipeContext) -> Iterable[Problem]:
        """Report too few input views for two different passes."""
        if context.inputs is not None and context.inputs < LEAST_VIEWS:
            reason = (
                f"it needs at least {LEAST_VIEWS} input views, got {context.inputs}: both passes "
                "use the first and the last view, so they would be the same"
            )
            yield Problem("", reason, FIX)

    def forward(self, inputs: Views, targets: Views, passes: Passes) -> Outcome:
        """Return the mean outcome, with the terms `alpha_consistency`, `depth_consistency`."""
        count = inputs.images.shape[1]
        outcomes = list[Outcome]()
        renderings = list[Rendering]()
        for part in (0, 1):
            some = inputs.select(subset(count, part))
            prediction = passes.predict(some)
            outcomes.append(passes.judge(prediction, targets, some))
            # Both are rendered from the target cameras, which neither pass has seen.
            renderings.append(passes.render(prediction.gaussians, targets.cameras))
        one, other = renderings
        return mean_outcome(
            outcomes,
            alpha_consistency=self.config.alpha_weight * disagreement(one.alpha, other.alpha),
            depth_consistency=self.config.depth_weight * disagreement(one.depth, other.depth),
        )


def subset(count: int, part: int) -> list[int]:
    """Return the first and the last of `count` views, and every other one between them."""
    return [0, *range(1 + part, count - 1, 2), count - 1]


@full_precision
def disagreement(one: Tensor, other: Tensor) -> Tensor:
    """Return the mean |one - other|, 0-d, as two halves in which one side gets no gradient.

    This is the symmetric stop-gradient of the paper. It is averaged; a sum would double the
    gradient.
    """
    # If neither side were held fixed, both would drift to the blurred mean.
    held = (one - other.detach()).abs().mean(), (other - one.detach()).abs().mean()
    return (held[0] + held[1]) / 2
