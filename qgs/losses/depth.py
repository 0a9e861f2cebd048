"""`qgs/depth_surface`, a loss that moves Gaussians to the surface of depth maps."""

import torch
import torch.nn.functional as F
from pydantic import Field
from torch import Tensor

from qgs.contracts import Loss
from qgs.geometry.transforms import to_camera
from qgs.precision import full_precision
from qgs.types import LayerPrediction, Rendering, Views
from qgs.wording import warn_once


class DepthSurface(Loss):
    """Smooth L1 between the camera-frame z of each Gaussian's centre and the depth map.

    The loss uses all target views with depth maps (`Views.depths`), and all input views with depth
    maps if the option `inputs` is true. Each centre counts with its smallest error over the views.
    So a centre on a surface that any view shows has the loss 0, even if other views do not see this
    surface. A view that is both target and input (`training.judge_inputs`) counts once. A batch
    without depth maps has the loss 0; the first such batch logs a warning.
    """

    name = "depth_surface"
    renderings = "none"
    reads_depths = True

    class Config(Loss.Config):
        beta: float = Field(default=0.05, gt=0)
        """Error in world units at which the loss changes from quadratic to linear."""
        near: float = Field(default=0.025, gt=0)
        """A view ignores Gaussians whose camera-frame z is at or below this, in world units."""
        inputs: bool = True
        """Use the depth maps of input views in addition to those of target views."""

    config: Config

    def term(
        self, prediction: LayerPrediction, rendering: Rendering, target: Views, inputs: Views
    ) -> Tensor:
        views = [target, inputs] if self.config.inputs else [target]
        measured = [view for view in views if view.depths is not None]
        means = prediction.gaussians.means
        mask = prediction.state.mask
        if not measured:
            warn_once(
                "a batch has no depth maps, so the loss qgs/depth_surface is 0 for it: if no "
                "scene has any, give `depth_file_path` in transforms.json, or remove the loss"
            )
            return 0 * means.sum()
        found = [
            surface_errors(means, view, self.config.beta, self.config.near) for view in measured
        ]
        errors, seen = (torch.cat(parts, 1) for parts in zip(*found, strict=True))  # (B, V, G)
        # Places without a query have Gaussians that nobody sees.
        if mask is not None:
            seen = seen & mask.repeat_interleave(means.shape[1] // mask.shape[1], 1)[:, None]
        nearest = (errors + torch.where(seen, 0.0, torch.inf)).amin(1)  # (B, G), inf where unseen
        # a scene in which no centre meets a measured pixel has the loss 0, with a gradient of 0
        total = nearest.masked_fill(nearest.isinf(), 0).sum(1)
        return (total / seen.any(1).sum(1).clamp_min(1)).mean()


@full_precision
def surface_errors(
    points: Tensor,  # (B, G, 3) world
    views: Views,  # (B, V) with depths
    beta: float,
    near: float,
) -> tuple[Tensor, Tensor]:
    """Return the smooth L1 error in z of each point in each view, and its validity, (B, V, G).

    An error is valid if the point lies beyond `near` and inside the image, and the depth of its
    pixel is known. The gradient treats the pixel as fixed, so it moves the point along the optical
    axis of the view. beta: error at which the loss changes from quadratic to linear.
    """
    assert views.depths is not None
    local = to_camera(points, views.cameras)  # (B, V, G, 3)
    z = local[..., 2]
    height, width = views.cameras.size
    with torch.no_grad():
        focal, centre = views.cameras.intrinsics[:, :, None].split(2, -1)
        # Points behind are left out below.
        safe = z.clamp_min(near)[..., None]
        # nearest pixel, as depths of both sides of an edge have no meaningful mean
        column, row = (focal * local[..., :2] / safe + centre).floor().unbind(-1)
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height) & (z > near)
        # Also where a centre is NaN.
        place = torch.where(inside, row * width + column, 0)
        depth = views.depths.flatten(2).gather(2, place.long())  # (B, V, G)
        seen = inside & (depth > 0)
    error = F.smooth_l1_loss(z, torch.where(seen, depth, z), beta=beta, reduction="none")
    return error, seen
