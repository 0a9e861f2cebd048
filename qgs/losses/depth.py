"""The loss `qgs/depth_surface`, which moves Gaussians to the surface that depth maps show."""

import torch
import torch.nn.functional as F
from pydantic import PositiveFloat
from torch import Tensor

from qgs.containers import concatenated
from qgs.contracts import Loss
from qgs.geometry.transforms import to_camera
from qgs.precision import full_precision
from qgs.types import LayerPrediction, Rendering, Views
from qgs.wording import warn_once


class DepthSurface(Loss):
    """Smooth L1 between the camera-frame z of each Gaussian's centre and the depth map.

    The loss uses all target views with depth maps (`Views.depths`), and all input views with depth
    maps if the option `inputs` is true. The error of a centre is the smallest of its errors over
    the views. So a centre on a surface that any view shows has error 0, even if the surface is
    hidden in other views. A view that is both target and input (`training.judge_inputs`) counts
    once. A batch without depth maps has loss 0; the first such batch logs a warning.
    """

    name = "depth_surface"
    renderings = "none"
    reads_depths = True

    class Config(Loss.Config):
        beta: PositiveFloat = 0.05
        """Error in world units at which the loss changes from quadratic to linear."""
        near: PositiveFloat = 0.025
        """Camera-frame z, in world units, at or below which a view ignores Gaussians."""
        inputs: bool = True
        """Use the depth maps of input views, in addition to those of target views."""

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
        errors, seen = concatenated(found, 1)  # (B, V, G)
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
    """Return smooth L1 errors (B, V, G) in z of points in views, and which of the errors are valid.

    B, V and G are scenes, views and points. An error is valid if the point lies beyond `near` and
    inside the image, and the depth of its pixel is known. The gradient treats the pixel as fixed,
    so it moves the point along the optical axis of the view. beta: error at which the loss changes
    from quadratic to linear.
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
