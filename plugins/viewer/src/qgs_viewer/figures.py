"""Draw sections of the report with Matplotlib as figures for papers, in PDF and PNG."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import Patch

from qgs.drawing.figures import figure_style
from qgs.files import replacing, write_text
from qgs.wording import listed
from qgs_viewer import sections
from qgs_viewer.commands import FigureName
from qgs_viewer.look import hex_color
from qgs_viewer.sections import Detail, Section, Shown

# Inches of a figure across a page of two columns.
WIDTH = 7.0
DPI = 220
# Pixels on the longer side of pictures that models render.
SIDE = 512
LISTING = "figures.md"


@torch.no_grad()
def write_figures(
    models: Shown,
    folder: Path,
    names: Sequence[FigureName],
    query: int | None,
    notes: Sequence[str],
) -> Iterator[str]:
    """Write figures and figures.md into `folder`; yield a line for each written or omitted figure.

    names: figures to draw; empty for all. query: index of the query to show; None chooses queries
    that are well visible. notes: sentences for the head of figures.md.
    """
    detail = Detail(SIDE, query)
    first = models[0].samples[0]
    scene = (
        f"Figures of one scene show {first.scene}, with input frames {listed(first.input_frames)}."
    )
    texts = [f"# {' and '.join(model.name for model in models)}", *notes, scene]
    for name in names or FigureName:
        section: Section = getattr(sections, name)(models, detail)
        if not section.rows:
            yield f"left out {name}: {section.words['empty']}"
            texts.append(f"{name} is left out: {section.words['empty']}.")
            continue
        write_figure(section.figure or grid(section), folder, name)
        yield f"{folder / name}.pdf, .png"
        text = section.words["text"]
        texts.append(f"## {name}\n\n![{name}]({name}.png)\n\n{text} ([PDF]({name}.pdf))")
    write_text(folder / LISTING, "\n\n".join(texts) + "\n")
    yield f"{folder / LISTING}: explains each figure"


def grid(section: Section) -> Figure:
    """Return a Matplotlib figure with a panel for each tile of `section`, without interpolation."""
    columns = max(map(len, section.rows.values()))
    tiles = [tile for tile in next(iter(section.rows.values())) if tile]
    # all pictures of a section have the shape of its first
    height, width = np.shape(tiles[0].image)[:2]
    # each panel has a line of text above it, and room for its legend below
    lines = 1 + max(len(tile.legend) for tile in tiles)
    row = WIDTH / columns * height / width + 0.2 * lines
    with figure_style(), rc_context({"font.size": 8, "axes.titlesize": 7}):
        layout = ConstrainedLayoutEngine(w_pad=0.02, h_pad=0.02, wspace=0.01, hspace=0.01)
        figure = Figure(figsize=(WIDTH, row * len(section.rows)), layout=layout)
        bare = {"xticks": [], "yticks": [], "frame_on": False}
        axes = figure.subplots(len(section.rows), columns, squeeze=False, subplot_kw=bare)
        for line, (label, row_tiles) in zip(axes, section.rows.items(), strict=True):
            # labels are turned by a right angle, where a long line has no room
            line[0].set_ylabel(label.replace(", ", "\n"))
            for axis, tile in zip(line, row_tiles, strict=False):
                if tile is None:
                    continue
                axis.imshow(tile.image, interpolation="nearest")
                axis.set_title(tile.caption)
                patches = [
                    Patch(color=hex_color(q.color), label=f"query {q.index}: {q.dispersion:.3f}")
                    for q in tile.legend
                ]
                if patches:
                    axis.legend(handles=patches, loc="upper left", bbox_to_anchor=(0, 0))
    return figure


def write_figure(figure: Figure, folder: Path, name: str) -> None:
    """Write a figure to NAME.png, and to NAME.pdf with text as characters, not as outlines.

    Equal figures give files of equal bytes.
    """
    # each drawing moves panels a little: both files show one layout
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    # a date would change the file at every run; type 42 keeps fonts that journals ask for
    metadata = {"CreationDate": None}
    for kind in ("pdf", "png"):
        with (
            replacing(folder / f"{name}.{kind}") as temporary,
            figure_style(),
            rc_context({"pdf.fonttype": 42}),
        ):
            figure.savefig(temporary, format=kind, dpi=DPI, metadata=metadata)
