"""Figure: which queries read which: self-attention as a graph on the plan of the scene."""

from collections.abc import Mapping, Sequence

import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from torch import Tensor

from qgs.drawing.figures import MUTED, hex_color
from qgs_viewer.figures.attention import PARTS
from qgs_viewer.figures.exhibits import Exhibit, Exhibition, NothingToShowError
from qgs_viewer.figures.layers import chosen_layers
from qgs_viewer.figures.paper import WIDTH, Made, new_figure, paper_style, row_label
from qgs_viewer.figures.plan import SHAPE, Plan, draw_ground, plan_of
from qgs_viewer.queries import DrawnQuery, rendered_weights

QUERIES = 5
LAYERS = 2
EDGES = 10
"""Edges of each chosen query, to those that it attends to most."""


def made(show: Exhibition) -> Made:
    """See `figure`. Raises NothingToShowError where no model explains its self-attention."""
    shown, chosen = telling(show.exhibits, show.query)
    if not shown:
        raise NothingToShowError("none of these models reports its self-attention")
    count = QUERIES if show.query is None else 1
    nodes = "at its anchor before the layer where it has one, else amid those of "
    nodes += "its Gaussians that the inputs see"
    caption = (
        f"Self-attention in scene {show.samples[0].scene} seen from above, input cameras as "
        f"triangles, Gaussians as pale dots in their colours. Every dark dot is a query, {nodes}. "
        f"Lines lead from {count} chosen queries (discs) to the {EDGES} queries that each attends "
        "to most, itself left out; broader is more, mean over heads. Lines that leave the plan "
        "lead to queries outside it."
    )
    if any(_parts(e) != ["weights"] for e in shown):
        caption += " Where geometry adds a bias, content and bias have their own panels."
    return Made(figure(shown, chosen), caption)


def telling(
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


@torch.no_grad()
def figure(exhibits: Sequence[Exhibit], chosen: Mapping[str, Sequence[DrawnQuery]]) -> Figure:
    """A row for each layer, first and last; a column for each model and part of its attention."""
    columns = [(shown, part) for shown in exhibits for part in _parts(shown)]
    layers = [chosen_layers(shown.look.depth, LAYERS) for shown, _ in columns]
    rows = max(map(len, layers))
    with paper_style():
        side = min((WIDTH - 0.3) / len(columns), 3.3)
        plans = {e.name: plan_of(e, nodes_of(e, e.look.depth)) for e in exhibits}
        height = side / SHAPE * rows
        drawn = new_figure(height + 0.25, gap=0.03, width=side * len(columns) + 0.3)
        axes = drawn.subplots(rows, len(columns), squeeze=False)
        for column, (shown, part) in enumerate(columns):
            for axis, layer in zip(axes[:, column], layers[column], strict=False):
                _panel(axis, shown, plans[shown.name], chosen[shown.name], layer, part)
                row_label(axis, f"layer {layer}")
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
    """World points (N, 3) of the queries before a layer, float64.

    Without anchors the mean of their Gaussians, weighted by their blending in the input views.
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
    found = shown.look.self_attention(0, shown.look.depth)
    assert found is not None
    return ["weights"] if found.geometry is None else list(PARTS)


def _panel(
    axis: Axes, shown: Exhibit, plan: Plan, chosen: Sequence[DrawnQuery], layer: int, part: str
) -> None:
    draw_ground(axis, shown, plan)
    places = plan.of(nodes_of(shown, layer)).numpy()
    axis.scatter(*places.T, s=3, color=hex_color(MUTED), linewidths=0, zorder=2)
    for query in chosen:
        color = hex_color(query.color)
        others, shares = strongest_edges(shown, query.index, layer, part)
        lines = [[places[query.index], places[other]] for other in others.tolist()]
        widths = (0.3 + 1.2 * shares).tolist()
        axis.add_collection(LineCollection(lines, colors=color, linewidths=widths, zorder=3))
        axis.scatter(*places[others].T, s=7, color=color, linewidths=0, zorder=4)
    for query in chosen:
        place = places[query.index]
        rim = {"edgecolors": "white", "linewidths": 0.7, "zorder": 5}
        axis.scatter(*place, s=34, color=hex_color(query.color), **rim)
