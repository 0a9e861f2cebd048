"""Figure: how anchors are refined: their ways, radii and steps from layer to layer."""

from collections.abc import Sequence

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from qgs.drawing.figures import MUTED, categorical, hex_color
from qgs_viewer.figures.anchors import support_of
from qgs_viewer.figures.exhibits import Exhibit, Exhibition
from qgs_viewer.figures.paper import INK_HEX, WIDTH, Made, new_figure, paper_style
from qgs_viewer.figures.plan import draw_ground, plan_of

BANDS = ((5, 95, 0.18), (25, 75, 0.35))
"""Percentiles between which a band lies, and how opaque it is."""
LAYER_MAP = "viridis_r"


def made(show: Exhibition) -> Made:
    """See `figure`. Raises NothingToShowError where no model has anchors."""
    exhibits = show.anchored
    caption = (
        f"Refinement of anchors in scene {show.samples[0].scene}. Left: the way of every anchor "
        "from its learned start (circle) to the last layer (dot), darker by layer, from above, "
        "with input cameras as triangles and Gaussians as pale dots. Right: radius by layer (of an "
        "ellipsoid the geometric mean of its semi-axes), layer 0 the learned start, and how far "
        "each layer moves an anchor; the line is the median over queries, bands hold 50 % and 90 % "
        f"of them. Units of the models' world.{show.without_anchors}"
    )
    return Made(figure(exhibits), caption)


def radii(shown: Exhibit) -> np.ndarray:
    """Radius of each query after each layer (layers + 1, N), 0 the start; geometric mean."""
    axes = [support_of(shown, layer).axes[0].double() for layer in range(shown.look.depth + 1)]
    return torch.linalg.det(torch.stack(axes)).abs().pow(1 / 3).numpy()


def ways(shown: Exhibit) -> torch.Tensor:
    """Anchors after each layer (layers + 1, N, 3), 0 the start; float64."""
    layers = range(shown.look.depth + 1)
    return torch.stack([support_of(shown, layer).centers[0].double() for layer in layers])


@torch.no_grad()
def figure(exhibits: Sequence[Exhibit]) -> Figure:
    """A plan of the ways for each model with anchors; radii and steps of all by layer."""
    with paper_style():
        wide = [1.25] * len(exhibits) + [1.0, 1.0]
        drawn = new_figure(max(2.1, WIDTH / sum(wide) * 1.05), gap=0.05)
        *plans, radius, step = drawn.subplots(1, len(wide), width_ratios=wide)
        for number, (axis, shown) in enumerate(zip(plans, exhibits, strict=True)):
            _ways(axis, shown)
            steps = (ways(shown)[1:] - ways(shown)[:-1]).norm(dim=-1).numpy()
            layers, color = np.arange(shown.look.depth + 1), hex_color(categorical(number))
            _bands(radius, layers, radii(shown), color, shown.name)
            _bands(step, layers[1:], steps, color, shown.name)
        for axis, title in ((radius, "support radius"), (step, "step of the anchor")):
            axis.set_title(f"{title}, world units")
            axis.set(xlabel="layer", ylim=(0, None))
            axis.xaxis.get_major_locator().set_params(integer=True)
        if len(exhibits) > 1:
            radius.legend()
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
    layers = np.arange(1, len(places))
    lines = np.stack([places[:-1], places[1:]], 2)  # (layers, N, 2 ends, 2)
    for layer, found in zip(layers, lines, strict=True):
        shade = np.full(len(found), layer / len(layers))
        drawn = LineCollection(list(found), array=shade, cmap=LAYER_MAP)
        axis.add_collection(drawn)
        drawn.set(linewidth=0.4, zorder=2, clim=(0, 1))
    start = {"facecolors": "none", "edgecolors": hex_color(MUTED), "linewidths": 0.4}
    axis.scatter(*places[0].T, s=4, zorder=3, **start)
    axis.scatter(*places[-1].T, s=3, color=INK_HEX, linewidths=0, zorder=3)
    axis.set_title(f"{shown.name}: ways of the anchors")
