"""Figures of anchors: their supports in a view layer by layer; their ways, radii and steps."""

from collections.abc import Sequence

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from qgs.drawing.figures import MUTED, categorical, hex_color
from qgs.drawing.images import finer
from qgs_viewer.figures import paper
from qgs_viewer.figures.exhibits import Exhibit, Exhibition, support_of
from qgs_viewer.figures.outside import draw_ground, plan_of
from qgs_viewer.figures.paper import Made, chosen_layers, logarithmic, new_figure, paper_style
from qgs_viewer.queries import DrawnQuery, query_picture

QUERIES = 6
LAYERS = 4  # states that are shown, the start among them
BANDS = ((5, 95, 0.18), (25, 75, 0.35))  # percentiles between which a band lies, and its opacity


def anchors(show: Exhibition) -> Made:
    """See `anchors_figure`. Raises NothingToShowError where no model has anchors."""
    exhibits, query = show.anchored, show.query
    count = QUERIES if query is None else 1
    which = f"{count} spread over this view, of large weight" if query is None else "the query"
    caption = paper.caption(
        "anchors", scene=show.samples[0].scene, which=which, without=show.without_anchors
    )
    chosen = {e.name: e.notable(count, e.sample.inputs.cameras[:, :1], query) for e in exhibits}
    return Made(anchors_figure(exhibits, chosen), caption)


@paper_style()
@torch.no_grad()
def anchors_figure(exhibits: Sequence[Exhibit], chosen: dict[str, list[DrawnQuery]]) -> Figure:
    """A row for each model with anchors: supports of `chosen` by layer, and their Gaussians."""
    columns = 1 + max(len(chosen_layers(e.look.depth, LAYERS, 0)) for e in exhibits)
    height, width = exhibits[0].sample.inputs.cameras.size
    drawn = new_figure((paper.WIDTH - 0.2) / columns * height / width * len(exhibits) + 0.2)
    axes = drawn.subplots(len(exhibits), columns, squeeze=False)
    for line, shown in zip(axes, exhibits, strict=True):
        camera = shown.sample.inputs.cameras[:, :1]
        layers = chosen_layers(shown.look.depth, LAYERS, 0)
        pictures = shown.anchors(layers, chosen[shown.name], paper.SIDE)
        for axis, layer, picture in zip(line, layers, pictures, strict=False):
            title = f"after layer {layer}" if layer else "start"
            paper.picture_panel(axis, picture, title)
        fine = finer(camera, paper.SIDE)
        picture = query_picture(shown.model, shown.gaussians, chosen[shown.name], fine)
        paper.picture_panel(line[len(layers)], picture, "Gaussians of these")
        for axis in line[len(layers) + 1 :]:
            axis.set_visible(False)
        line[0].set_ylabel(shown.name, labelpad=paper.PAD)
    return drawn


def refinement(show: Exhibition) -> Made:
    """See `refinement_figure`. Raises NothingToShowError where no model has anchors."""
    exhibits = show.anchored
    caption = paper.caption("refinement", scene=show.samples[0].scene, without=show.without_anchors)
    return Made(refinement_figure(exhibits), caption)


def radii(shown: Exhibit) -> np.ndarray:
    """Radius of each query after each layer (layers + 1, N), 0 the start; geometric mean."""
    axes = [support_of(shown, layer).axes[0].double() for layer in range(shown.look.depth + 1)]
    return torch.linalg.det(torch.stack(axes)).abs().pow(1 / 3).numpy()


def ways(shown: Exhibit) -> torch.Tensor:
    """Anchors after each layer (layers + 1, N, 3), 0 the start; float64."""
    layers = range(shown.look.depth + 1)
    return torch.stack([support_of(shown, layer).centers[0].double() for layer in layers])


@paper_style()
@torch.no_grad()
def refinement_figure(exhibits: Sequence[Exhibit]) -> Figure:
    """A plan of the ways for each model with anchors; radii and steps of all by layer."""
    wide = [1.25] * len(exhibits) + [1.0, 1.0]
    drawn = new_figure(max(2.3, paper.WIDTH / sum(wide) * 1.05), gap=0.05)
    *plans, radius, step = drawn.subplots(1, len(wide), width_ratios=wide)
    for number, (axis, shown) in enumerate(zip(plans, exhibits, strict=True)):
        _ways(axis, shown)
        steps = (ways(shown)[1:] - ways(shown)[:-1]).norm(dim=-1).numpy()
        layers, color = np.arange(shown.look.depth + 1), hex_color(categorical(number))
        _bands(radius, layers, radii(shown), color, shown.name)
        _bands(step, layers[1:], steps, color, shown.name)
    for axis, title in ((radius, "support radius"), (step, "anchor's step")):
        axis.set_title(f"{title},\nworld units")
        medians = np.concatenate([line.get_ydata() for line in axis.lines])
        if not logarithmic(axis, medians.tolist()):
            axis.set_ylim(0, None)
        axis.set_xlabel("layer")
        axis.xaxis.get_major_locator().set_params(integer=True)
    if len(exhibits) > 1:
        drawn.legend(*radius.get_legend_handles_labels(), loc="outside lower right", ncols=3)
    return drawn


def _bands(axis: Axes, layers: np.ndarray, values: np.ndarray, color: str, name: str) -> None:
    """Median of values (layers, N) over queries, and BANDS about it."""
    for low, high, alpha in BANDS:
        ends = np.percentile(values, [low, high], axis=1)
        axis.fill_between(layers, *ends, color=color, alpha=alpha, linewidth=0)
    marked = {"marker": "o", "markersize": 2.5, "label": name}
    axis.plot(layers, np.median(values, 1), color=color, **marked)


def _ways(axis: Axes, shown: Exhibit) -> None:
    plan = plan_of(shown)
    draw_ground(axis, shown, plan)
    places = plan.of(ways(shown)).numpy()
    lines = np.stack([places[:-1], places[1:]], 2)  # (layers, N, 2 ends, 2)
    for layer, found in enumerate(lines, start=1):
        shade = np.full(len(found), layer / len(lines))
        drawn = LineCollection(list(found), array=shade, cmap="viridis_r")
        axis.add_collection(drawn)
        drawn.set(linewidth=0.4, zorder=2, clim=(0, 1))
    start = {"facecolors": "none", "edgecolors": hex_color(MUTED), "linewidths": 0.4}
    axis.scatter(*places[0].T, s=4, zorder=3, **start)
    axis.scatter(*places[-1].T, s=3, color=paper.INK_HEX, linewidths=0, zorder=3)
    axis.set_title(f"{shown.name}:\nways of the anchors")
