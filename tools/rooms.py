"""Picture of the modules of qgs and their imports, for the start of docs/design.md.

    python tools/rooms.py

A room is a package or module in `qgs/`, or a distribution in `plugins/`. Each room is drawn above
the rooms that it imports. An arrow leads to an imported room, unless a path of other arrows leads
to it.
"""

import re
from importlib import import_module
from pathlib import Path
from textwrap import shorten

import grimp
import networkx as nx
from jinja2 import Template
from size import ROOT

PICTURE = ROOT / "docs/images/rooms.svg"
TEMPLATE = Path(__file__).with_name("rooms.svg.jinja")
GAP = 14
ROW = 104
ACROSS = 182
"""Distance between the left edges of neighbouring rooms, in pixels."""
COLUMNS = 7


def rooms() -> nx.DiGraph:
    """Return the graph of all rooms, with an edge from each room to every room that it imports."""
    plugins = {init.parent.name for init in (ROOT / "plugins").glob("*/src/*/__init__.py")}
    code = grimp.build_graph("qgs", *plugins, cache_dir=None)
    names = (plugins | code.find_children("qgs")) - {"qgs.__main__"}
    for name in names:
        code.squash_module(name)
    arrows = nx.DiGraph()
    arrows.add_nodes_from(names)
    for name in names:
        found = code.find_modules_directly_imported_by(name) & names - {name}
        arrows.add_edges_from((name, to) for to in found)
    return arrows


def title(room: str) -> str:
    """Return the first words of the docstring of `room`, as a short title."""
    text = import_module(room).__doc__ or ""
    return shorten(re.split("[:,.]", text.replace("`", ""))[0], 30, placeholder=" ...")


def drawn() -> str:
    """Return the picture of all rooms as SVG."""
    arrows = rooms()
    lines: list[list[str]] = []
    # The first generation is imported by no other; reversed, it imports none.
    ground, *upper = nx.topological_generations(arrows.reverse())
    for row in (*reversed(upper), ground):
        names = sorted(row)
        lines += [names[start : start + COLUMNS] for start in range(0, len(names), COLUMNS)]
    places: dict[str, tuple[float, int]] = {}
    for number, names in enumerate(lines):
        left = (COLUMNS - len(names)) * ACROSS / 2 + GAP
        for column, name in enumerate(names):
            places[name] = (left + column * ACROSS, GAP + number * ROW)
    reduced = nx.transitive_reduction(arrows)
    edges = sorted(edge for edge in reduced.edges if edge[1] not in ground)
    return Template(TEMPLATE.read_text("utf-8"), autoescape=True, trim_blocks=True).render(
        width=COLUMNS * ACROSS + GAP,
        height=len(lines) * ROW,
        arrows=[(*places[name], *places[other]) for name, other in edges],
        rooms=[(name.removeprefix("qgs."), *place, title(name)) for name, place in places.items()],
    )


if __name__ == "__main__":
    PICTURE.write_text(drawn(), "utf-8")
