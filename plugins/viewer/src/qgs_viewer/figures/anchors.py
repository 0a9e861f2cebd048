"""Figure: anchors with their supports in a view, layer by layer, and the Gaussians they place."""

from collections.abc import Sequence

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from qgs.drawing.images import enlarged, finer, rgb_picture
from qgs.types import SpatialSupport, map_tensors
from qgs_viewer.figures.exhibits import Exhibit, Exhibition
from qgs_viewer.figures.layers import chosen_layers, layer_name
from qgs_viewer.figures.paper import (
    SIDE,
    WIDTH,
    Made,
    new_figure,
    paper_style,
    picture_panel,
    row_label,
)
from qgs_viewer.queries import DrawnQuery, query_picture, support_picture

QUERIES = 6
LAYERS = 4
"""States that are shown, the learned start among them."""


def made(show: Exhibition) -> Made:
    """See `figure`. Raises NothingToShowError where no model has anchors."""
    exhibits, query = show.anchored, show.query
    count = QUERIES if query is None else 1
    which = f"{count} that matter to this view and stand apart" if query is None else "the query"
    caption = (
        f"Anchors in scene {show.samples[0].scene}: every query's anchor as a dot on the first "
        f"input view; {which} with the support in colour, where all of it lies before the camera. "
        "From the learned start, the same for every scene, each layer moves them. Last column: the "
        f"Gaussians of these queries, with lines to their centroids.{show.without_anchors}"
    )
    chosen = {e.name: e.notable(count, e.sample.inputs.cameras[:, :1], query) for e in exhibits}
    return Made(figure(exhibits, chosen), caption)


@torch.no_grad()
def figure(exhibits: Sequence[Exhibit], chosen: dict[str, list[DrawnQuery]]) -> Figure:
    """A row for each model with anchors: supports of `chosen` by layer, and their Gaussians."""
    columns = 1 + max(len(chosen_layers(e.look.depth, LAYERS, 0)) for e in exhibits)
    height, width = exhibits[0].sample.inputs.cameras.size
    with paper_style():
        drawn = new_figure((WIDTH - 0.2) / columns * height / width * len(exhibits) + 0.2)
        axes = drawn.subplots(len(exhibits), columns, squeeze=False)
        for line, shown in zip(axes, exhibits, strict=True):
            _row(line, shown, chosen[shown.name])
    return drawn


def _row(axes: Sequence[Axes], shown: Exhibit, chosen: Sequence[DrawnQuery]) -> None:
    camera = shown.sample.inputs.cameras[:, :1]
    photo = enlarged(rgb_picture(shown.sample.inputs.images[0, 0]), SIDE)
    colors = {query.index: query.color for query in chosen}
    layers = chosen_layers(shown.look.depth, LAYERS, 0)
    for axis, layer in zip(axes, layers, strict=False):
        picture = support_picture(photo, support_of(shown, layer), camera.to("cpu"), colors)
        picture_panel(axis, picture, layer_name(layer))
    picture = query_picture(shown.model, shown.gaussians, chosen, finer(camera, SIDE))
    picture_panel(axes[len(layers)], picture, "Gaussians of these")
    for axis in axes[len(layers) + 1 :]:
        axis.set_visible(False)
    row_label(axes[0], shown.name)


def support_of(shown: Exhibit, layer: int) -> SpatialSupport:
    """Supports (1, N) after a layer, of a model with anchors; float32 on the CPU."""
    found = shown.look.support(layer)
    assert found is not None
    return map_tensors(lambda tensor: tensor.float(), found)
