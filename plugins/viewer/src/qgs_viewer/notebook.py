"""Show models as tables and predictions as pictures in notebooks."""

import torch

from qgs.drawing.images import depth_picture, depth_range, png_bytes, rgb_picture, side_by_side
from qgs.model import QueryGaussianModel
from qgs.model_text import heading, slot_rows
from qgs.renderers import AutoRenderer
from qgs.types import Cameras, Prediction
from qgs_viewer.look import page_environment

# Pixels of the picture of a prediction, and the focal length of its lens.
SIDE = 192


def model_html(model: QueryGaussianModel) -> str:
    """Return HTML with the model's sizes and a table of its components with parameter counts."""
    template = page_environment().get_template("model.html")
    return template.render(heading=heading(model), rows=slot_rows(model))


@torch.no_grad()
def prediction_png(prediction: Prediction) -> bytes | None:
    """Return a PNG with colours and depth of the first scene, rendered from its world origin.

    The recipe puts the origin at the first input camera or at the mean of all input cameras.
    Returns None if no Gaussian lies in front of the origin, or if positions are not finite.
    """
    gaussians = prediction.gaussians[:1]
    means = gaussians.means[0].float()
    # predictions on the meta device have shapes, but no numbers
    if means.is_meta or not means.isfinite().all() or not (means[:, 2] > 0).any():
        return None
    lens = means.new_tensor([[[SIDE, SIDE, SIDE / 2, SIDE / 2]]])
    camera = Cameras(torch.eye(4).to(means)[None, None], lens, (SIDE, SIDE))
    seen = AutoRenderer(AutoRenderer.Config())(gaussians, camera)
    depth = depth_picture(seen.depth[0, 0], *depth_range(seen.depth))
    return png_bytes(side_by_side([rgb_picture(seen.rgb[0, 0]), depth]))


def show_pictures() -> None:
    """Let notebooks show models as tables and predictions as pictures, for the whole process."""
    QueryGaussianModel._repr_html_ = model_html  # type: ignore[attr-defined]
    Prediction._repr_png_ = prediction_png  # type: ignore[attr-defined]
