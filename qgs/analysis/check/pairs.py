"""Two photos with what they share, and the epipolar lines that the poses predict."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from qgs.analysis.pictures.palette import figure_style
from qgs.data.check.epipolar import Pair, epipolar_lines
from qgs.io.drawing import Picture

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MATCHES = 14
_GAP = 0.02


def pair_figure(pair: Pair, photos: tuple[Picture, ...]) -> Figure:
    """Both photos, in each the matches as dots and the line on which the poses want them.

    A dot off its line of the same colour is what a wrong pose looks like.
    """
    from matplotlib.figure import Figure

    chosen = _spread(pair.matches.first, _MATCHES)
    points = (pair.matches.first[chosen], pair.matches.second[chosen])
    first, second = pair.poses
    lines = epipolar_lines(pair.matches, first, second, pair.intrinsics)
    height, width = pair.size
    with figure_style():
        figure = Figure(figsize=(8.0, 4.0 * height / width * (1 - _GAP) + 0.3))
        axes = figure.subplots(1, 2)
        figure.subplots_adjust(0, 0, 1, 0.93, wspace=_GAP)
        for axis, photo, dots, wanted, frame in zip(
            axes, photos, points, lines, pair.frames, strict=True
        ):
            _photo(axis, photo, dots, wanted[chosen])
            axis.set_title(f"frame {frame}")
    return figure


def _spread(points: np.ndarray, count: int) -> np.ndarray:
    """Indices of points far from each other, the first one nearest the mean."""
    chosen = [int(np.linalg.norm(points - points.mean(0), axis=1).argmin())]
    apart = np.full(len(points), np.inf)
    while len(chosen) < min(count, len(points)):
        apart = np.minimum(apart, np.linalg.norm(points - points[chosen[-1]], axis=1))
        chosen.append(int(apart.argmax()))
    return np.array(chosen)


def _photo(axis: Axes, photo: Picture, points: np.ndarray, lines: np.ndarray) -> None:
    from matplotlib import colormaps

    height, width = photo.shape[:2]
    light = (255 - (255 - photo.astype(float)) * 0.6).astype(np.uint8)
    axis.imshow(light, extent=(0, width, height, 0))
    colors = colormaps["turbo"](np.linspace(0.05, 0.95, len(points)))
    for point, (a, b, c), color in zip(points, lines, colors, strict=True):
        x, y = _across(a, b, c, width, height)
        axis.plot(x, y, color=color, linewidth=1.0)
        axis.plot(*point, "o", markersize=4.5, color=color, markeredgecolor="white", mew=0.7)
    axis.set(xlim=(0, width), ylim=(height, 0), xticks=[], yticks=[])
    axis.grid(visible=False)
    axis.spines[:].set_visible(False)


def _across(a: float, b: float, c: float, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Two points of the line a x + b y + c = 0, at the edges that it crosses."""
    if abs(b) >= abs(a):
        x = np.array([0.0, width])
        return x, -(a * x + c) / b
    y = np.array([0.0, height])
    return -(b * y + c) / a, y
