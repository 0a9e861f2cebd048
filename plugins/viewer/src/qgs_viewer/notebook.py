"""Pictures in notebooks: of a model its way from views to Gaussians, of a prediction its scene."""

from collections.abc import Mapping
from html import escape

import torch

from qgs.contracts import LearnedQueries
from qgs.drawing.images import depth_picture, depth_range, png_bytes, rgb_picture, side_by_side
from qgs.model import QueryGaussianModel
from qgs.model_text import heading, parameter_counts, slot_rows
from qgs.renderers import AutoRenderer
from qgs.types import Cameras, Prediction

SIDE = 192  # pixels of the picture of a prediction
OUTSIDE = 0.04  # share of the Gaussians that it may leave out at its sides
WIDEST = 1.2  # tangent of half the widest view
LETTER, LINE, PAD, GAP = 6.7, 16, 8, 34
"""Pixels: a letter's width, a line's height, space around text, the length of arrows."""


def pipeline_svg(
    kinds: Mapping[str, str], counts: Mapping[str, int], depth: int, learned: bool
) -> str:
    """Boxes and arrows in the colour of the text around.

    kinds, counts: components and parameters by slot, of decoder layers as "decoder.SLOT".
    learned: whether queries start from parameters alone, and only the decoder reads photos.
    """

    def lines_of(*slots: str) -> list[str]:
        lines = [f"{slot.split('.')[-1]}: {kinds[slot]}" for slot in slots if kinds[slot]]
        return [*lines, f"{sum(counts[slot] for slot in slots):,} parameters"]

    inside = [slot for slot in counts if slot.startswith("decoder.")]
    columns = [  # of boxes, of lines
        [["views", "photos", "cameras"]],
        [lines_of("encoder"), lines_of("queries")],
        [[f"{depth} decoder layers", *lines_of(*inside)]],
        [lines_of("head", "centers")],
        [["Gaussians"]],
    ]
    lows = [sum(len(box) * LINE + 6 + PAD for box in column) + PAD for column in columns]
    high = max(lows)
    left, parts, ends = 1.0, list[str](), list[float]()
    for column, low in zip(columns, lows, strict=True):
        wide = max(len(line) for box in column for line in box) * LETTER + 2 * PAD
        gap, end, middles = PAD + (high - low) / (len(column) + 1), 0.0, list[float]()
        for box in column:
            half = len(box) * LINE / 2 + 3
            middle, end = end + gap + half, end + gap + 2 * half
            middles.append(middle)
            size = f'width="{wide:.0f}" height="{2 * half:.0f}" rx="4" fill="none"'
            parts.append(f'<rect x="{left:.0f}" y="{middle - half:.0f}" {size}/>')
            for number, line in enumerate(box):
                place = f'x="{left + PAD:.0f}" y="{middle - half + LINE * (number + 1) - 1:.0f}"'
                parts.append(f'<text {place} stroke="none">{escape(line)}</text>')
            if not (learned and box[0].startswith("queries")):
                way = f"{left - GAP / 2:.0f} {middle:.0f} {left - 6:.0f} {middle:.0f}h6l-7-4v8l7-4"
                parts += [f'<path d="M{left - GAP:.0f} {y:.0f}S{way}" fill="none"/>' for y in ends]
        left, ends = left + wide + GAP, middles
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {left - GAP + 2:.0f} {high:.0f}" '
        f'width="{left - GAP + 2:.0f}" fill="currentColor" stroke="currentColor" '
        f'style="max-width:100%;font:11px ui-monospace,monospace">{"".join(parts)}</svg>'
    )


def model_html(model: QueryGaussianModel) -> str:
    """A picture of the way from views to Gaussians, and the same as a table."""
    rows = ["".join(f"<td>{escape(cell)}</td>" for cell in row) for row in slot_rows(model)]
    kinds = {slot: kind for slot, kind, _ in slot_rows(model)}
    learned = isinstance(model.queries, LearnedQueries)
    picture = pipeline_svg(kinds, parameter_counts(model), model.depth, learned)
    body = "".join(f"<tr>{row}</tr>" for row in rows)
    head = "<tr><th>slot</th><th>component</th><th>parameters</th></tr>"
    return f"<p>{escape(heading(model))}</p>{picture}<table>{head}{body}</table>"


@torch.no_grad()
def prediction_png(prediction: Prediction) -> bytes | None:
    """The first scene and its depth from the origin of its world; None if nothing lies before it.

    There stands the first input camera, or the mean of all, whichever the recipe says.
    """
    gaussians, means = prediction.gaussians[:1], prediction.gaussians.means[0].float()
    if means.is_meta or not means.isfinite().all():
        return None
    before = means[(means[:, 2] > 0) & (gaussians.opacities[0] > 0.05)]
    if len(before) == 0:
        return None
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
