"""`globalsplat/frustum`, `globalsplat/regularisers`: Gaussians in sight, few, small."""

import math

import torch
import torch.nn.functional as F
from pydantic import Field
from torch import Tensor

from qgs.contracts import Loss
from qgs.geometry.precision import full_precision
from qgs.geometry.transforms import to_camera
from qgs.losses import mean_of_gaussians
from qgs.types import Cameras, LayerPrediction, Rendering, Views


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
