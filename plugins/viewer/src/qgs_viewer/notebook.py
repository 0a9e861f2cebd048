"""Pictures in notebooks: a model's path from views to Gaussians, the scene of a prediction."""

import torch

from qgs.contracts import LearnedQueries
from qgs.drawing import page_environment
from qgs.drawing.images import depth_picture, depth_range, png_bytes, rgb_picture, side_by_side
from qgs.model import QueryGaussianModel
from qgs.model_text import heading, parameter_counts, slot_rows
from qgs.renderers import AutoRenderer
from qgs.types import Cameras, Prediction

# Pixels of the picture of a prediction.
SIDE = 192
# Share of the Gaussians that it may leave out at its sides.
OUTSIDE = 0.04
# Tangent of half the widest view.
WIDEST = 1.2


def model_html(model: QueryGaussianModel) -> str:
    """Draw the path from views to Gaussians as boxes and arrows, and the same as a table."""
    rows = slot_rows(model)
    kinds = {slot: kind for slot, kind, _ in rows}
    counts = parameter_counts(model)

    def box(*slots: str) -> list[str]:
        lines = [f"{slot.split('.')[-1]}: {kinds[slot]}" for slot in slots if kinds[slot]]
        return [*lines, f"{sum(counts[slot] for slot in slots):,} parameters"]

    layers = box(*(slot for slot in counts if slot.startswith("decoder.")))
    columns = [
        [["views", "photos", "cameras"]],
        [box("encoder"), box("queries")],
        [[f"{model.depth} decoder layers", *layers]],
        [box("head", "centers")],
        [["Gaussians"]],
    ]
    return (
        page_environment("qgs_viewer")
        .get_template("model.html")
        .render(
            heading=heading(model),
            columns=columns,
            rows=rows,
            # such queries start from parameters alone, and only the decoder reads photos
            learned=isinstance(model.queries, LearnedQueries),
        )
    )


@torch.no_grad()
def prediction_png(prediction: Prediction) -> bytes | None:
    """Render the first scene and its depth from the origin; None if nothing lies before it.

    There stands the first input camera, or the mean of all, whichever the recipe says.
    """
    gaussians = prediction.gaussians[:1]
    means = gaussians.means[0].float()
    if means.is_meta or not means.isfinite().all():
        return None
    before = means[(means[:, 2] > 0) & (gaussians.opacities[0] > 0.05)]
    if len(before) == 0:
        return None
    # the view is as wide as what lies before the origin, less outliers
    slopes = (before[:, :2] / before[:, 2:]).abs().amax(-1)
    focal = SIDE / 2 / float(slopes.quantile(1 - OUTSIDE).clamp(0.1, WIDEST))
    lens = means.new_tensor([[[focal, focal, SIDE / 2, SIDE / 2]]])
    camera = Cameras(torch.eye(4).to(means)[None, None], lens, (SIDE, SIDE))
    seen = AutoRenderer(AutoRenderer.Config())(gaussians, camera)
    depth = depth_picture(seen.depth[0, 0], *depth_range(seen.depth))
    return png_bytes(side_by_side([rgb_picture(seen.rgb[0, 0]), depth]))


def show_pictures() -> None:
    """Have notebooks show models and predictions as pictures from now on."""
    QueryGaussianModel._repr_html_ = model_html  # type: ignore[attr-defined]
    Prediction._repr_png_ = prediction_png  # type: ignore[attr-defined]
