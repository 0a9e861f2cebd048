"""The look of figures in papers: sizes, type, pictures as panels, and how they are written."""

import tomllib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.resources import files
from io import BytesIO
from pathlib import Path
from typing import Any

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from qgs.drawing.figures import INK, figure_style, hex_color
from qgs.drawing.images import Picture
from qgs.files import replacing

WIDTH = 7.0  # inches of a figure across a page of two columns
DPI = 220
PAD = 2.5  # points between a panel and its label
SIDE = 512  # pixels on the longer side of pictures that models render for a panel
INK_HEX = hex_color(INK)
FAR_APART = 20  # ratio of the greatest value to the least from which a scale is logarithmic


@dataclass(frozen=True)
class Made:
    """A figure with its caption, in plain sentences."""

    figure: Figure
    caption: str


def chosen_layers(depth: int, most: int, first: int = 1) -> list[int]:
    """At most `most` layers from `first` to `depth`, evenly, both among them."""
    count = min(most, depth - first + 1)
    if count < 2:
        return [depth]
    return [first + round(i * (depth - first) / (count - 1)) for i in range(count)]


@contextmanager
def paper_style() -> Iterator[None]:
    """Matplotlib settings while a figure is drawn and while it is written; also a decorator."""
    sizes: dict[Any, Any] = {
        "font.size": 8,
        "axes.titlesize": 8,
        "axes.labelsize": 8,
        "xtick.labelsize": 7,
        "ytick.labelsize": 7,
        "legend.fontsize": 7.5,
        "axes.linewidth": 0.6,
        "lines.linewidth": 1.2,
        "pdf.fonttype": 42,
    }
    with figure_style(), rc_context(sizes):
        yield


def caption(name: str, **values: object) -> str:
    """The caption of a figure in template/captions.toml, `values` filled in."""
    file = files("qgs_viewer") / "template" / "captions.toml"
    found: str = tomllib.loads(file.read_text(encoding="utf-8"))[name]["caption"]
    return found.format(**values)


def logarithmic(axis: Axes, values: Sequence[float]) -> bool:
    """Whether y of `axis` is logarithmic now: positive `values` FAR_APART make it so."""
    far = max(values) > FAR_APART * min(values) > 0
    if far:
        axis.set_yscale("log")
        axis.tick_params(axis="y", which="minor", length=0)
    return far


def new_figure(height: float, gap: float = 0.02, width: float = WIDTH) -> Figure:
    """An empty figure, inches, with at least `gap` inches between panels."""
    figure = Figure(figsize=(width, height))
    figure.set_layout_engine(ConstrainedLayoutEngine(w_pad=gap, h_pad=gap, wspace=0, hspace=0))
    return figure


def picture_panel(axis: Axes, picture: Picture, title: str = "") -> None:
    """A picture without frame and ticks, its pixels as they are."""
    axis.imshow(picture, interpolation="nearest", aspect="equal")
    blank_panel(axis)
    if title:
        axis.set_title(title, pad=PAD)


def blank_panel(axis: Axes) -> None:
    """A panel without frame, ticks and grid."""
    axis.set(xticks=[], yticks=[])
    axis.grid(visible=False)
    axis.spines[:].set_visible(False)
    axis.patch.set_visible(False)


def tag(axis: Axes, text: str) -> None:
    """A few words in the lower left corner of a picture."""
    box = {"facecolor": INK_HEX, "alpha": 0.65, "edgecolor": "none", "pad": 1.5}
    place = {"transform": axis.transAxes, "ha": "left", "va": "bottom"}
    axis.text(0.03, 0.03, text, color="white", fontsize=6.5, bbox=box, **place)


def write_figure(figure: Figure, folder: Path, name: str) -> None:
    """NAME.pdf with text as text, and NAME.png; the same figure gives the same bytes."""
    for kind, metadata in (("pdf", {"CreationDate": None}), ("png", {})):
        buffer = BytesIO()
        with paper_style():
            figure.savefig(buffer, format=kind, dpi=DPI, metadata=metadata)
        with replacing(folder / f"{name}.{kind}") as temporary:
            temporary.write_bytes(buffer.getvalue())
