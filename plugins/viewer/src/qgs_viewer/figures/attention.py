"""Figure: what one query reads in the input photos, split into content, geometry and result."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from qgs.contracts import AttentionWeights
from qgs.drawing.figures import categorical, hex_color
from qgs.drawing.images import enlarged, rgb_picture
from qgs.types import Cameras
from qgs_viewer.figures.anchors import support_of
from qgs_viewer.figures.exhibits import Exhibit, Exhibition, NothingToShowError
from qgs_viewer.figures.layers import chosen_layers
from qgs_viewer.figures.paper import (
    WIDTH,
    Made,
    blank_panel,
    new_figure,
    paper_style,
    picture_panel,
    row_label,
)
from qgs_viewer.queries import (
    OUTLINE_POINTS,
    DrawnQuery,
    attention_pictures,
    patch_maps,
    project_support,
)

LAYERS = 3
VIEWS = 2
"""Input views that are shown."""
PARTS = {"content": "content logits", "geometry": "geometry bias", "weights": "attention"}
PHOTO = 256
"""Pixels on the longer side of a photo."""
ANCHOR = categorical(1)


def made(show: Exhibition) -> Made:
    """See `figure`. Raises NothingToShowError where no model explains its cross-attention."""
    shown = [e for e in show.exhibits if e.look.attention(0, e.look.depth) is not None]
    if not shown:
        raise NothingToShowError("none of these models reports its cross-attention")
    queries = {e.name: e.notable(1, e.sample.targets.cameras[:, :1], show.query)[0] for e in shown}
    told = ", ".join(f"{name} query {query.index}" for name, query in queries.items())
    views = len(show.samples[0].input_frames)
    photos = f"{VIEWS} of {views}" if views > VIEWS else "the"
    caption = (
        f"Cross-attention of one query ({told}) over the patches of {photos} input "
        f"photos of scene {show.samples[0].scene}, means over heads, in several layers. "
        "Content logits, the bias that geometry adds to them where there is one, and the attention "
        "that results; strong colour is much, the photos of one part share one scale from their "
        "least to their greatest value. Blue: the query's anchor when it read, and its support."
    )
    return Made(figure(shown, queries), caption)


@torch.no_grad()
def figure(exhibits: Sequence[Exhibit], queries: Mapping[str, DrawnQuery]) -> Figure:
    """Rows: layers of each model. Columns: the parts of PARTS, VIEWS photos each."""
    layers = {e.name: chosen_layers(e.look.depth, LAYERS) for e in exhibits}
    views = min(VIEWS, exhibits[0].sample.inputs.images.shape[1])
    height, width = exhibits[0].sample.inputs.cameras.size
    rows = sum(map(len, layers.values()))
    gap = 0.25
    side = (WIDTH - 0.35) / (len(PARTS) * views + (len(PARTS) - 1) * gap)
    ratios = [*([1.0] * views + [gap]) * (len(PARTS) - 1), *[1.0] * views]
    with paper_style():
        drawn = new_figure((side * height / width + 0.03) * rows + 0.3, gap=0.012)
        axes = drawn.subplots(rows, len(ratios), width_ratios=ratios, squeeze=False)
        for axis in axes.flat:
            blank_panel(axis)
        for axis in axes[:, np.array(ratios) == 1].flat:
            axis.set_box_aspect(height / width)
        lines = iter(axes)
        for shown in exhibits:
            for layer in layers[shown.name]:
                _row(next(lines), shown, queries[shown.name].index, layer, views)
        for number, title in enumerate(PARTS.values()):
            axes[0, number * (views + 1)].set_title(title)
    return drawn


def _row(axes: Sequence[Axes], shown: Exhibit, query: int, layer: int, views: int) -> None:
    weights = shown.look.attention(query, layer)
    row_label(axes[0], f"{shown.name}\nlayer {layer}")
    for number, part in enumerate(PARTS):
        maps = part_maps(shown, weights, part)
        places = axes[number * (views + 1) : number * (views + 1) + views]
        if maps is None:
            if number:
                middle = {"ha": "center", "va": "center", "transform": places[0].transAxes}
                places[0].text(1.0, 0.5, "none", in_layout=False, **middle)
            continue
        photos = [
            enlarged(rgb_picture(image), PHOTO) for image in shown.sample.inputs.images[0, :views]
        ]
        pictures = attention_pictures(photos, maps[:views])
        for view, axis in enumerate(places):
            picture_panel(axis, pictures[view])
            _anchor(axis, shown, query, layer - 1, view, pictures[view].shape[1])


def part_maps(shown: Exhibit, weights: AttentionWeights | None, part: str) -> np.ndarray | None:
    """Mean over heads of one of PARTS for each view (V, H/P, W/P); None where there is none."""
    values: Tensor | None = getattr(weights, part) if weights is not None else None
    return None if values is None else patch_maps(values[0, :, 0], shown.look.grid)


def _anchor(axis: Axes, shown: Exhibit, query: int, layer: int, view: int, width: int) -> None:
    """The anchor of a query after a layer, and the outline of its support, in an input view."""
    if shown.look.support(layer) is None:
        return
    cameras: Cameras = shown.sample.inputs.cameras[:, view : view + 1].to("cpu")
    seen = project_support(support_of(shown, layer), cameras)
    scale, color = width / cameras.size[1], hex_color(ANCHOR)
    frozen = {"scalex": False, "scaley": False, "color": color, "clip_on": True}
    if seen.whole[query]:
        angle = torch.linspace(0, 2 * torch.pi, OUTLINE_POINTS)
        circle = torch.stack([angle.cos(), angle.sin()])
        ring = (seen.centers[query][:, None] + seen.axes[query] @ circle) * scale - 0.5
        axis.plot(*ring.numpy(), linewidth=0.9, **frozen)
    if seen.depths[query] > 0:
        x, y = (seen.points[query] * scale - 0.5).tolist()
        axis.plot([x], [y], marker="o", markersize=2.2, markeredgewidth=0, **frozen)
