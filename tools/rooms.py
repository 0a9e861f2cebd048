"""The picture of the rooms that docs/design.md begins with, drawn from the imports.

    python tools/rooms.py

A room is a package or module of `qgs/`, or a distribution of `plugins/`. Rooms stand above what
they import. An arrow leads to a room that is imported and that no other arrow leads to already.
"""

import ast
from pathlib import Path

import networkx as nx
from jinja2 import Template

ROOT = Path(__file__).parents[1]
PICTURE = ROOT / "docs/images/rooms.svg"
TEMPLATE = Path(__file__).with_name("rooms.svg.jinja")
GAP = 14
ROW = 104
ACROSS = 182
"""From the left of a room to that of the next."""
COLUMNS = 7


def rooms() -> dict[str, list[Path]]:
    """Return the name of every room, and its files."""
    found: dict[str, list[Path]] = {}
    for path in sorted((ROOT / "qgs").iterdir()):
        if path.is_dir() and (path / "__init__.py").is_file():
            found[path.name] = sorted(path.rglob("*.py"))
        elif path.suffix == ".py" and not path.name.startswith("__"):
            found[path.stem] = [path]
    for folder in sorted((ROOT / "plugins").glob("*/src/*")):
        found[folder.name] = sorted(folder.rglob("*.py"))
    return found


def imports(files: list[Path]) -> set[str]:
    """Return the rooms that `files` import, by statements anywhere in them."""
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


def graph() -> nx.DiGraph:
    """Return every room, with an edge to each other room that it imports."""
    found = rooms()
    arrows = nx.DiGraph()
    for name, files in found.items():
        arrows.add_node(name)
        arrows.add_edges_from((name, to) for to in imports(files) & found.keys() - {name})
    return arrows


def title(files: list[Path]) -> str:
    """Return the first words of a room's docstring."""
    text = ast.get_docstring(ast.parse(files[0].read_text(encoding="utf-8"))) or ""
    words = text.splitlines()[0].split(":")[0].split(",")[0].rstrip(".").replace("`", "")
    return words if len(words) <= 30 else words[:29].rsplit(" ", 1)[0] + " ..."


def drawn() -> str:
    """Return the picture as SVG."""
    arrows = graph()
    files = rooms()
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
        rooms=[(name, *place, title(files[name])) for name, place in places.items()],
    )


if __name__ == "__main__":
    PICTURE.write_text(drawn(), encoding="utf-8")
