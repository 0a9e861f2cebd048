"""Matplotlib style of all figures, and figures that show a grid of pictures with a depth scale."""

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from io import BytesIO
from pathlib import Path

import numpy as np
from matplotlib import colormaps, style
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from PIL import Image

from qgs.drawing.images import DEPTH_MAP, Picture

COLUMN_INCHES = 1.9


def figure_style() -> AbstractContextManager[None]:
    """Return a context manager that sets the project's Matplotlib style inside its block."""
    return style.context(Path(__file__).with_name("figures.mplstyle"))


def figure_picture(figure: Figure, dpi: int = 120) -> Picture:
    """Render a figure to an RGB array (H, W, 3) of uint8."""
    buffer = BytesIO()
    with figure_style():
        figure.savefig(buffer, format="png", dpi=dpi)
    return np.asarray(Image.open(buffer).convert("RGB"))


def grid_figure(
    rows: Mapping[str, Sequence[Picture]],
    columns: Sequence[str],
    depths: tuple[float, float] | None = None,
) -> Figure:
    """Draw a grid of pictures, with titles above the columns.

    rows: pictures of each row, by the label of the row. columns: titles of the columns. depths:
        (near, far) of a depth scale beside the last row, in world units; None draws no scale.
    """
    height, width, _ = next(iter(rows.values()))[0].shape
    row_inches = COLUMN_INCHES * height / width
    # Labels, titles and the scale take the rest.
    inches = (COLUMN_INCHES * len(columns) + 0.9, row_inches * len(rows) + 0.6)
    with figure_style():
        figure = Figure(figsize=inches, layout="constrained")
        figure.get_layout_engine().set(w_pad=0.02, h_pad=0.02, wspace=0.01, hspace=0.01)  # type: ignore[union-attr]
        axes = figure.subplots(len(rows), len(columns), squeeze=False)
        for line, (label, pictures) in zip(axes, rows.items(), strict=True):
            for axis, picture in zip(line, pictures, strict=True):
                axis.imshow(picture)
                axis.set(xticks=[], yticks=[])
                axis.spines[:].set_visible(False)
            line[0].set_ylabel(label)
        for axis, title in zip(axes[0], columns, strict=True):
            axis.set_title(title)
        if depths:
            scale = ScalarMappable(Normalize(*depths), colormaps[DEPTH_MAP])
            bar = figure.colorbar(scale, ax=list(axes[-1]), fraction=0.03, pad=0.01)
            bar.set_label("depth, world units")
            bar.outline.set_visible(False)  # type: ignore[operator]
    return figure
