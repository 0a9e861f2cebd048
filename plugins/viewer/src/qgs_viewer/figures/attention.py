"""Figures of attention: what one query reads in the photos, and which queries read which."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from torch import Tensor

from qgs.contracts import AttentionWeights
from qgs.drawing.figures import MUTED, categorical, hex_color
from qgs.drawing.images import enlarged, rgb_picture
from qgs_viewer.figures import paper
from qgs_viewer.figures.exhibits import Exhibit, Exhibition, NothingToShowError, support_of
from qgs_viewer.figures.outside import PLAN_SHAPE, Plan, draw_ground, plan_of
from qgs_viewer.figures.paper import WIDTH, Made, chosen_layers, new_figure, paper_style
from qgs_viewer.queries import (
    DrawnQuery,
    attention_pictures,
    patch_maps,
    project_support,
    rendered_weights,
)

CROSS_LAYERS = 3
SELF_LAYERS = 2
VIEWS = 2  # input views that are shown
PARTS = {"content": "content logits", "geometry": "geometry bias", "weights": "attention"}
PHOTO = 256  # pixels on the longer side of a photo
QUERIES = 5  # queries whose self-attention is shown
EDGES = 10  # edges of each of them, to those that it attends to most


def cross_attention(show: Exhibition) -> Made:
    """See `cross_attention_figure`. Raises NothingToShowError where no model explains it."""
    shown = [e for e in show.exhibits if e.look.attention(0, e.look.depth) is not None]
    if not shown:
        raise NothingToShowError("none of these models reports its cross-attention")
    queries = {e.name: e.notable(1, e.sample.targets.cameras[:, :1], show.query)[0] for e in shown}
    named = ", ".join(f"{name} query {query.index}" for name, query in queries.items())
    views = len(show.samples[0].input_frames)
    photos = f"{VIEWS} of {views}" if views > VIEWS else "the"
    caption = paper.caption(
        "cross_attention", queries=named, photos=photos, scene=show.samples[0].scene
    )
    return Made(cross_attention_figure(shown, queries), caption)


@paper_style()
@torch.no_grad()
def cross_attention_figure(
    exhibits: Sequence[Exhibit], queries: Mapping[str, DrawnQuery]
) -> Figure:
    """Rows: layers of each model. Columns: the parts of PARTS, VIEWS photos each."""
    layers = [(e, layer) for e in exhibits for layer in chosen_layers(e.look.depth, CROSS_LAYERS)]
    views = min(VIEWS, exhibits[0].sample.inputs.images.shape[1])
    height, width = exhibits[0].sample.inputs.cameras.size
    gap = 0.25
    side = (WIDTH - 0.35) / (len(PARTS) * views + (len(PARTS) - 1) * gap)
    ratios = [*([1.0] * views + [gap]) * (len(PARTS) - 1), *[1.0] * views]
    drawn = new_figure((side * height / width + 0.03) * len(layers) + 0.3, gap=0.012)
    axes = drawn.subplots(len(layers), len(ratios), width_ratios=ratios, squeeze=False)
    for axis in axes.flat:
        paper.blank_panel(axis)
    for axis in axes[:, np.array(ratios) == 1].flat:
        axis.set_box_aspect(height / width)
    for line, (shown, layer) in zip(axes, layers, strict=True):
        _reading(line, shown, queries[shown.name].index, layer, views)
    for number, title in enumerate(PARTS.values()):
        axes[0, number * (views + 1)].set_title(title)
    return drawn


def _reading(axes: Sequence[Axes], shown: Exhibit, query: int, layer: int, views: int) -> None:
    weights = shown.look.attention(query, layer)
    axes[0].set_ylabel(f"{shown.name}\nlayer {layer}", labelpad=paper.PAD)
    photos = [enlarged(rgb_picture(i), PHOTO) for i in shown.sample.inputs.images[0, :views]]
    for number, part in enumerate(PARTS):
        maps = part_maps(shown, weights, part)
        places = axes[number * (views + 1) : number * (views + 1) + views]
        if maps is None and number:
            middle = {"ha": "center", "va": "center", "transform": places[0].transAxes}
            places[0].text(1.0, 0.5, "none", in_layout=False, **middle)
        if maps is None:
            continue
        for view, picture in enumerate(attention_pictures(photos, maps[:views])):
            paper.picture_panel(places[view], picture)
            _anchor(places[view], shown, query, layer - 1, view, picture.shape[1])


def part_maps(shown: Exhibit, weights: AttentionWeights | None, part: str) -> np.ndarray | None:
    """Mean over heads of one of PARTS for each view (V, H/P, W/P); None where there is none."""
    values: Tensor | None = getattr(weights, part) if weights is not None else None
    return None if values is None else patch_maps(values[0, :, 0], shown.look.grid)


def _anchor(axis: Axes, shown: Exhibit, query: int, layer: int, view: int, width: int) -> None:
    """The anchor of a query after a layer, and the outline of its support, in an input view."""
    if shown.look.support(layer) is None:
        return
    cameras = shown.sample.inputs.cameras[:, view : view + 1].to("cpu")
    seen = project_support(support_of(shown, layer), cameras)
    scale, color = width / cameras.size[1], hex_color(categorical(1))
    frozen = {"scalex": False, "scaley": False, "color": color, "clip_on": True}
    if seen.whole[query]:
        axis.plot(*(seen.outline(query) * scale - 0.5).numpy(), linewidth=0.9, **frozen)
    if seen.depths[query] > 0:
        x, y = (seen.points[query] * scale - 0.5).tolist()
        axis.plot([x], [y], marker="o", markersize=2.2, markeredgewidth=0, **frozen)


def self_attention(show: Exhibition) -> Made:
    """See `self_attention_figure`. Raises NothingToShowError where no model explains it."""
    shown, chosen = self_attending(show.exhibits, show.query)
    if not shown:
        raise NothingToShowError("none of these models reports its self-attention")
    count = QUERIES if show.query is None else 1
    scene = show.samples[0].scene
    caption = paper.caption("self_attention", scene=scene, count=count, edges=EDGES)
    if any(_parts(e) != ["weights"] for e in shown):
        caption += " Where geometry adds a bias, content and bias have their own panels."
    return Made(self_attention_figure(shown, chosen), caption)


def self_attending(
    exhibits: Sequence[Exhibit], query: int | None = None
) -> tuple[list[Exhibit], dict[str, list[DrawnQuery]]]:
    """The models that report their self-attention, and by name the queries to show of each."""
    count, chosen = QUERIES if query is None else 1, dict[str, list[DrawnQuery]]()
    for shown in exhibits:
        drawn = shown.notable(count, shown.sample.targets.cameras[:, :1], query)
        shown.look.trace([0, *(one.index for one in drawn)])
        if shown.look.self_attention(0, shown.look.depth) is not None:
            chosen[shown.name] = drawn
    return [shown for shown in exhibits if shown.name in chosen], chosen


@paper_style()
@torch.no_grad()
def self_attention_figure(
    exhibits: Sequence[Exhibit], chosen: Mapping[str, Sequence[DrawnQuery]]
) -> Figure:
    """A row for each layer, first and last; a column for each model and part of its attention."""
    columns = [(shown, part) for shown in exhibits for part in _parts(shown)]
    layers = [chosen_layers(shown.look.depth, SELF_LAYERS) for shown, _ in columns]
    rows = max(map(len, layers))
    side = min((WIDTH - 0.3) / len(columns), 3.3)
    plans = {e.name: plan_of(e, nodes_of(e, e.look.depth)) for e in exhibits}
    size = side / PLAN_SHAPE * rows + 0.25, side * len(columns) + 0.3
    drawn = new_figure(size[0], gap=0.03, width=size[1])
    axes = drawn.subplots(rows, len(columns), squeeze=False)
    for column, (shown, part) in enumerate(columns):
        for axis, layer in zip(axes[:, column], layers[column], strict=False):
            _graph(axis, shown, plans[shown.name], chosen[shown.name], layer, part)
            axis.set_ylabel(f"layer {layer}", labelpad=paper.PAD)
        title = shown.name if part == "weights" else f"{shown.name}, {PARTS[part]}"
        axes[0, column].set_title(title)
    return drawn


def strongest_edges(shown: Exhibit, query: int, layer: int, part: str) -> tuple[Tensor, Tensor]:
    """The EDGES queries that `query` reads most, (k,), and each one's share of the most, (k,).

    Of logits and biases the share is exp of the difference to the greatest.
    """
    attention = shown.look.self_attention(query, layer)
    assert attention is not None
    values = getattr(attention, part)[0, :, 0].float().mean(0).cpu().clone()
    values[query] = -torch.inf
    found = values.topk(min(EDGES, len(values) - 1))
    if part == "weights":
        return found.indices, found.values / found.values[0].clamp_min(1e-30)
    return found.indices, (found.values - found.values[0]).exp()


def nodes_of(shown: Exhibit, layer: int) -> Tensor:
    """World points (N, 3) of the queries before a layer, float64: anchors, else means of Gaussians.

    Means are weighted by the blending in the input views.
    """
    support = shown.look.support(layer - 1)
    if support is not None:
        return support.centers[0]
    gaussians, count = shown.gaussians, shown.look.queries
    weights = rendered_weights(shown.model, gaussians, shown.sample.inputs.cameras)[0]
    shares = weights.cpu().double().view(count, -1, 1).clamp_min(1e-12)
    means = gaussians.means[0].detach().cpu().double().view(count, -1, 3)
    return (means * shares).sum(1) / shares.sum(1)


def _parts(shown: Exhibit) -> list[str]:
    layers = chosen_layers(shown.look.depth, SELF_LAYERS)
    found = [shown.look.self_attention(0, layer) for layer in layers]
    return list(PARTS) if all(one and one.geometry is not None for one in found) else ["weights"]


def _graph(
    axis: Axes, shown: Exhibit, plan: Plan, chosen: Sequence[DrawnQuery], layer: int, part: str
) -> None:
    draw_ground(axis, shown, plan)
    places = plan.of(nodes_of(shown, layer)).numpy()
    axis.scatter(*places.T, s=3, color=hex_color(MUTED), linewidths=0, zorder=2)
    rim = {"s": 34, "edgecolors": "white", "linewidths": 0.7, "zorder": 5}
    for query in chosen:
        color = hex_color(query.color)
        others, shares = strongest_edges(shown, query.index, layer, part)
        lines = [[places[query.index], places[other]] for other in others.tolist()]
        widths = (0.3 + 1.2 * shares).tolist()
        axis.add_collection(LineCollection(lines, colors=color, linewidths=widths, zorder=3))
        axis.scatter(*places[others].T, s=7, color=color, linewidths=0, zorder=4)
        axis.scatter(*places[query.index], color=color, **rim)
