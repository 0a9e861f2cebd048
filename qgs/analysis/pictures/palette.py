"""Colours and type that all pictures share. Categorical colours: Okabe and Ito (2008)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from qgs.io.drawing import NOTHING

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
PAPER: Color = (255, 255, 255)
ATTENTION_MAP = "magma"


def hex_color(color: Color) -> str:
    """#rrggbb."""
    return "#{:02x}{:02x}{:02x}".format(*color)


def categorical(index: int) -> Color:
    """The colour of the `index`-th series or token; they repeat after six."""
    return CATEGORICAL[index % len(CATEGORICAL)]


@contextmanager
def figure_style() -> Iterator[None]:
    """Matplotlib settings of every figure, for the `with` block only."""
    from matplotlib import rc_context

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
    with rc_context(style):
        yield
