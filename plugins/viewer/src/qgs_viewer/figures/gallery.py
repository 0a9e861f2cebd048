"""The figures by name, and their files: PDF and PNG each, and figures.md with what they show."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

from qgs.io.files import write_text
from qgs.wording import listed
from qgs_viewer.figures import (
    anchors,
    attention,
    curves,
    dispersion,
    global_gaussians,
    graph,
    novel_views,
    refinement,
)
from qgs_viewer.figures.exhibits import Exhibition, NothingToShowError
from qgs_viewer.figures.paper import Made, write_figure

FIGURES: Mapping[str, Callable[[Exhibition], Made]] = {
    "global_gaussians": global_gaussians.made,
    "novel_views": novel_views.made,
    "anchors": anchors.made,
    "refinement": refinement.made,
    "cross_attention": attention.made,
    "self_attention": graph.made,
    "dispersion": dispersion.made,
    "curves": curves.made,
}
LISTING = "figures.md"


def refuse_unknown(names: Sequence[str]) -> None:
    """Raise ValueError for a name that is no figure's."""
    if unknown := [name for name in names if name not in FIGURES]:
        raise ValueError(f"--only: no figure {listed(unknown)}; there are {listed(FIGURES, 20)}")


def write_all(show: Exhibition, folder: Path, names: Sequence[str] = ()) -> Iterator[str]:
    """Write the figures `names`, all by default; says of each, once it is there, what it is.

    Figures that these models have nothing for are told, and left out.
    """
    texts = [f"# {' and '.join(show.models)}", *show.notes]
    for name in names or FIGURES:
        try:
            made = FIGURES[name](show)
        except NothingToShowError as error:
            yield f"left out {name}: {error}"
            texts.append(f"{name} is left out: {error}.")
            continue
        write_figure(made.figure, folder, name)
        yield f"{folder / name}.pdf, .png"
        texts.append(f"## {name}\n\n![{name}]({name}.png)\n\n{made.caption} ([PDF]({name}.pdf))")
    write_text(folder / LISTING, "\n\n".join(texts) + "\n")
    yield f"{folder / LISTING}: what each shows"
