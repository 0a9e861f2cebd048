"""`qgs/depth_surface`: Gaussians on the surface that depth maps show."""

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
    """Smooth L1 between the camera-frame z of each Gaussian's centre and the depth map behind it.

    Of all target views, and input views if asked for, that have depth maps (`Views.depths`), the
    view with the smallest error counts for a centre: a surface hidden in one view is not drawn to
    what hides it there, and centres on surfaces that any view shows have the loss 0. A view that
    is both target and input (`training.judge_inputs`) thus counts once. A batch without depth maps
    has the loss 0; the first one is logged as a warning.
    """

    name = "depth_surface"
    renderings = "none"
    reads_depths = True

    class Config(Loss.Config):
        beta: float = Field(default=0.05, gt=0)
        """Error at which the loss turns from a parabola into a line, world units."""
        near: float = Field(default=0.025, gt=0)
        """Camera-frame z at or below which a centre is behind a view and not compared there."""
        inputs: bool = True
        """Whether input views count beside target views."""

    config: Config

    def term(
        self, prediction: LayerPrediction, rendering: Rendering, target: Views, inputs: Views
    ) -> Tensor:
        """See `Loss`."""
        views = [target, inputs] if self.config.inputs else [target]
        measured = [view for view in views if view.depths is not None]
        means = prediction.gaussians.means
        mask = prediction.state.mask
        if not measured:
            warn_once(
                "a batch has no depth maps, so the loss qgs/depth_surface is 0 for it: where no "
                "scene has any, give `depth_file_path` in transforms.json, or take the loss out"
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
    """Smooth L1 error in z of each point in each view, and where it counts; (B, V, G) both.

    It counts in front of `near`, inside the image, and where the depth of the pixel is known. The
    pixel is constant for the gradient, which moves a point along the view's axis.
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
