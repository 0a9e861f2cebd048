"""Losses and objective of GlobalSplat.

`globalsplat/frustum` keeps Gaussians in view, `globalsplat/regularisers` keeps them transparent and
small. The objective `globalsplat/two_passes` makes predictions from different photos agree.
"""

import math
from collections.abc import Iterable

import torch
import torch.nn.functional as F
from pydantic import NonNegativeFloat, PositiveFloat
from torch import Tensor

from qgs.contracts import ComponentConfig, Loss, Objective, Outcome, Passes, Problem, RecipeContext
from qgs.geometry.transforms import to_camera
from qgs.losses import mean_of_gaussians
from qgs.precision import full_precision
from qgs.types import Cameras, LayerPrediction, Rendering, Views
from qgs_zoo.parts import mean_outcome


class Frustum(Loss):
    """Mean distance of Gaussian means from the frusta of the input cameras.

    The distance of a Gaussian is small if its mean is inside of any of the frusta; `beyond_frusta`
    defines it.
    """

    name = "frustum"
    renderings = "none"

    class Config(Loss.Config):
        weight: NonNegativeFloat = 0.01
        """Weight of the loss in the objective."""
        softness: PositiveFloat = 0.05
        """Width of the smooth transition of the loss at the border of a frustum, in world units."""
        near: NonNegativeFloat = 0.05
        """Depth (camera-frame z) of the near plane of a frustum, in world units."""

    config: Config

    def term(
        self, prediction: LayerPrediction, rendering: Rendering, target: Views, inputs: Views
    ) -> Tensor:
        means = prediction.gaussians.means
        per_point = beyond_frusta(means, inputs.cameras, self.config.softness, self.config.near)
        return mean_of_gaussians(per_point, prediction)


class Regularisers(Loss):
    """Mean opacity and mean scale of the Gaussians as losses (3DGS as MCMC, Kheradmand 2024)."""

    name = "regularisers"
    scheduled = frozenset({"weight", "opacity_weight", "scale_weight"})
    renderings = "none"

    class Config(Loss.Config):
        opacity_weight: NonNegativeFloat = 0.01
        """Weight of the mean opacity in the loss."""
        scale_weight: NonNegativeFloat = 0.01
        """Weight of the mean scale, which is in world units, in the loss."""

    config: Config

    def term(
        self, prediction: LayerPrediction, rendering: Rendering, target: Views, inputs: Views
    ) -> dict[str, Tensor]:
        """Return the weighted losses `mean_opacity` and `mean_scale`."""
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
    """Return smooth distances (B, P) >= 0 of points (B, P, 3) from the frusta of all views.

    P: number of points. Distances are in world units, and small if a point is in any frustum. A
    frustum has five planes: four for the borders of the image, and the near plane at depth `near`.
    The distance x of a point from a frustum is the sum over the planes of t softplus(y / t), with y
    the point's distance beyond a plane and t = `softness`. The result is the soft minimum over
    frusta, -t log mean exp(-x / t). It has a gradient everywhere, even behind a camera, and never
    divides by a depth.
    """
    x, y, z = to_camera(points, cameras).unbind(-1)
    fx, fy, cx, cy = cameras.intrinsics[..., None, :].unbind(-1)
    height, width = cameras.size
    # Signed distances to planes through the camera's centre: no division by depth.
    borders = [(x, fx, cx), (-x, fx, width - cx), (y, fy, cy), (-y, fy, height - cy)]
    inside = [(focal * side + c * z) / torch.hypot(focal, c) for side, focal, c in borders]
    depths = torch.stack([*inside, z - near])  # positive inside
    beyond_BVP = F.softplus(-depths / softness).sum(0)
    return softness * (math.log(cameras.shape[1]) - torch.logsumexp(-beyond_BVP, 1))


LEAST_VIEWS = 3
FIX = "raise views.inputs, or choose `objective: {type: qgs/one_pass}`"


class TwoPasses(Objective):
    """Objective of two predictions from different input views, which should agree.

    Both predictions read the first and the last view. Of the views between, one prediction reads
    every second view, and the other prediction reads the rest. The recipe's losses apply to both
    predictions. Both are rendered from the target cameras, and two more losses compare alpha and
    depth of these renderings.
    """

    name = "two_passes"
    scheduled = frozenset({"alpha_weight", "depth_weight"})

    class Config(ComponentConfig):
        """Options, with GlobalSplat's defaults."""

        alpha_weight: NonNegativeFloat = 1e-3
        """Weight of the loss `alpha_consistency`, the mean difference between alphas of the
        renderings of both predictions."""
        depth_weight: NonNegativeFloat = 1e-2
        """Weight of the loss `depth_consistency`, the mean difference in world units between depths
        of the renderings of both predictions."""

    config: Config

    @classmethod
    def problems(cls, config: ComponentConfig, context: RecipeContext) -> Iterable[Problem]:
        """Report fewer than three input views, because both passes would read all of them."""
        if context.inputs is not None and context.inputs < LEAST_VIEWS:
            reason = (
                f"it needs at least {LEAST_VIEWS} input views, got {context.inputs}: both passes "
                "use the first and the last view, so they would be the same"
            )
            yield Problem("", reason, FIX)

    def forward(self, inputs: Views, targets: Views, passes: Passes) -> Outcome:
        """Return the mean outcome of both passes, plus two losses that compare their renderings.

        These losses are `alpha_consistency` and `depth_consistency`.
        """
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
    """Return indices of the first view, the last one, and every second view between them.

    count: number of views. part: 0 takes the second, fourth, ... view; 1 takes the third, fifth,
    ... view.
    """
    return [0, *range(1 + part, count - 1, 2), count - 1]


@full_precision
def disagreement(one: Tensor, other: Tensor) -> Tensor:
    """Return the mean of |one - other|, 0-d, with the symmetric stop-gradient of the paper.

    The paper has the mean of two equal terms. In the first, `other` gets no gradient, in the
    second, `one` gets none. So each side gets half of the gradient that it would get without stops.
    """
    apart = (one - other).abs().mean()
    return (apart + apart.detach()) / 2
