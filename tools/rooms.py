"""Picture of the modules of qgs and their imports, for the start of docs/design.md.

    python tools/rooms.py

A room is a package or module in `qgs/`, or a distribution in `plugins/`. Each room is drawn above
the rooms that it imports. An arrow leads to an imported room, unless a path of other arrows leads
to it.
"""

import ast
import re
from pathlib import Path
from textwrap import shorten

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


def rooms() -> dict[str, list[Path]]:
    """Return the Python files of every room, by name of the room."""
    folders = sorted((ROOT / "qgs").iterdir()) + sorted((ROOT / "plugins").glob("*/src/*"))
    found = {x.stem: sorted(x.rglob("*.py")) if x.is_dir() else [x] for x in folders}
    # Neither `__main__`, nor what tells type checkers that there are types, nor old folders.
    python = {name: [f for f in files if f.suffix == ".py"] for name, files in found.items()}
    return {name: files for name, files in python.items() if files and "__" not in name}


def imports(files: list[Path]) -> set[str]:
    """Return the rooms that `files` import, also inside functions."""
    names = set[str]()
    for file in files:
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module:
                names |= {f"{node.module}.{alias.name}" for alias in node.names}
            elif isinstance(node, ast.Import):
                names |= {alias.name for alias in node.names}
    parts = [name.split(".") for name in names]
    own = {part[1] for part in parts if part[0] == "qgs" and len(part) > 1}
    return own | {part[0] for part in parts if part[0].startswith("qgs_")}


def title(file: Path) -> str:
    """Return the first words of the docstring of `file`, as a short title."""
    text = ast.get_docstring(ast.parse(file.read_text(encoding="utf-8"))) or ""
    return shorten(re.split("[:,.]", text.replace("`", ""))[0], 30, placeholder=" ...")


def drawn() -> str:
    """Return the picture of all rooms as SVG."""
    files = rooms()
    arrows = nx.DiGraph()
    arrows.add_nodes_from(files)
    for name, own in files.items():
        arrows.add_edges_from((name, to) for to in imports(own) & files.keys() - {name})
    lines: list[list[str]] = []
    # The first generation is imported by no other; reversed, it imports none.
    ground, *upper = nx.topological_generations(arrows.reverse())
    for row in (*reversed(upper), ground):
        names = sorted(row, key=lambda name: (name.startswith("qgs_"), name))
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
        rooms=[(name, *place, title(files[name][0])) for name, place in places.items()],
    )


if __name__ == "__main__":
    PICTURE.write_text(drawn(), encoding="utf-8")
