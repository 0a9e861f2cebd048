"""The look of all figures: colours, type, grids of pictures with a depth scale."""

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from io import BytesIO
from typing import Any

import numpy as np
from matplotlib import colormaps, rc_context
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from PIL import Image

from qgs.drawing.images import DEPTH_MAP, NOTHING, Picture

Color = tuple[int, int, int]

CATEGORICAL: tuple[Color, ...] = (
    (213, 94, 0),
    (0, 114, 178),
    (0, 158, 115),
    (204, 121, 167),
    (230, 159, 0),
    (86, 180, 233),
)
"""Distinct for colour-blind readers, on light ground and on photos."""

INK: Color = (32, 36, 42)
MUTED: Color = (122, 128, 136)
COLUMN_INCHES = 1.9


def hex_color(color: Color) -> str:
    """#rrggbb."""
    return "#{:02x}{:02x}{:02x}".format(*color)


def categorical(index: int) -> Color:
    """The colour of the `index`-th series or token; they repeat after six."""
    return CATEGORICAL[index % len(CATEGORICAL)]


def figure_style() -> AbstractContextManager[None]:
    """Matplotlib settings of every figure, for the `with` block only."""
    ink = hex_color(INK)
    style: dict[Any, Any] = {
        "font.family": "sans-serif",
        "font.size": 9,
        "text.color": ink,
        "axes.labelcolor": ink,
        "axes.edgecolor": hex_color(MUTED),
        "axes.linewidth": 0.7,
        "axes.titlesize": 9,
        "axes.titlelocation": "left",
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.grid": True,
        "grid.color": hex_color(NOTHING),
        "grid.linewidth": 0.7,
        "axes.axisbelow": True,
        "xtick.color": hex_color(MUTED),
        "ytick.color": hex_color(MUTED),
        "xtick.labelcolor": ink,
        "ytick.labelcolor": ink,
        "lines.linewidth": 1.6,
        "legend.frameon": False,
        "figure.facecolor": "white",
    }
    return rc_context(style)


def figure_picture(figure: Figure, dpi: int = 120) -> Picture:
    """The figure as a picture."""
    buffer = BytesIO()
    with figure_style():
        figure.savefig(buffer, format="png", dpi=dpi)
    return np.asarray(Image.open(buffer).convert("RGB"))


def grid_figure(
    rows: Mapping[str, Sequence[Picture]],
    columns: Sequence[str],
    depth_row: tuple[str, float, float] | None = None,
) -> Figure:
    """Rows of pictures under column titles; `depth_row` (row, near, far) gets a colour scale."""
    aspect = np.divide(*next(iter(rows.values()))[0].shape[:2])
    size = (COLUMN_INCHES * len(columns) + 0.9, COLUMN_INCHES * aspect * len(rows) + 0.6)
    with figure_style():
        figure = Figure(figsize=size, layout="constrained")
        figure.get_layout_engine().set(w_pad=0.02, h_pad=0.02, wspace=0.01, hspace=0.01)  # type: ignore[union-attr]
        axes = figure.subplots(len(rows), len(columns), squeeze=False)
        for line, (label, pictures) in zip(axes, rows.items(), strict=True):
            for axis, picture in zip(line, pictures, strict=True):
                axis.imshow(picture)
                axis.set(xticks=[], yticks=[])
                axis.spines[:].set_visible(False)
            line[0].set_ylabel(label)
            if depth_row and label == depth_row[0]:
                scale = ScalarMappable(Normalize(*depth_row[1:]), colormaps[DEPTH_MAP])
                bar = figure.colorbar(scale, ax=list(line), fraction=0.03, pad=0.01)
                bar.set_label("depth, world units")
                bar.outline.set_visible(False)  # type: ignore[operator]
        for axis, title in zip(axes[0], columns, strict=True):
            axis.set_title(title)
    return figure


def running_mean(values: Sequence[float], share: float = 0.05) -> np.ndarray:
    """Centred mean over `share` of the values, going straight on from its last whole windows."""
    array, index = np.asarray(values, dtype=float), np.arange(len(values))
    if (half := int(len(array) * share / 2)) == 0:
        return array
    width, ends = 2 * half + 1, (slice(2 * half + 1), slice(-6 * half, None))  # steep, then flat
    first = np.clip(index - half, 0, len(array) - width)
    means, away = np.correlate(array, np.full(width, 1 / width), "valid"), index - first - half
    slopes = [np.polyfit(index[end], array[end], 1)[0] for end in ends]
    return means[first] + away * np.where(away < 0, *slopes)
