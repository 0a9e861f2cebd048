"""The picture of the rooms that docs/design.md begins with, drawn from the imports.

    python tools/rooms.py

A room is a package or module of `qgs/`, or a distribution of `plugins/`. Rooms stand above what
they import. An arrow leads to a room that is imported and that no other arrow leads to already.
"""

import ast
from collections import defaultdict
from html import escape
from pathlib import Path

ROOT = Path(__file__).parents[1]
PICTURE = ROOT / "docs/images/rooms.svg"
WIDTH, HEIGHT, GAP, ROW = 168, 50, 14, 104
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


def graph() -> dict[str, set[str]]:
    """Return every room and the others that it imports."""
    found = rooms()
    return {name: (imports(files) & found.keys()) - {name} for name, files in found.items()}


def reach(arrows: dict[str, set[str]], start: str) -> set[str]:
    """Return all rooms that `start` leads to."""
    seen = set[str]()
    waiting = [start]
    while waiting:
        for name in arrows[waiting.pop()] - seen:
            seen.add(name)
            waiting.append(name)
    return seen


def reduced(arrows: dict[str, set[str]]) -> dict[str, set[str]]:
    """Return `arrows` without those that a longer way makes needless."""
    far = {name: reach(arrows, name) for name in arrows}
    return {
        name: {to for to in others if not any(to in far[way] for way in others - {to})}
        for name, others in arrows.items()
    }


def heights(arrows: dict[str, set[str]]) -> dict[str, int]:
    """Return the row of every room, 0 at the bottom: one above the highest that it imports."""
    found: dict[str, int] = {}

    def height(name: str) -> int:
        if name not in found:
            found[name] = 1 + max((height(other) for other in arrows[name]), default=-1)
        return found[name]

    for name in arrows:
        height(name)
    return found


def title(files: list[Path]) -> str:
    """Return the first words of a room's docstring."""
    text = ast.get_docstring(ast.parse(files[0].read_text(encoding="utf-8"))) or ""
    words = text.splitlines()[0].split(":")[0].split(",")[0].rstrip(".").replace("`", "")
    return words if len(words) <= 30 else words[:29].rsplit(" ", 1)[0] + " ..."


def drawn() -> str:
    """Return the picture as SVG."""
    arrows = graph()
    files = rooms()
    rows: dict[int, list[str]] = defaultdict(list)
    for name, row in heights(arrows).items():
        rows[row].append(name)
    lines: list[list[str]] = []
    for row in sorted(rows, reverse=True):
        names = sorted(rows[row], key=lambda name: (name.startswith("qgs_"), name))
        lines += [names[start : start + COLUMNS] for start in range(0, len(names), COLUMNS)]
    across = WIDTH + GAP
    places: dict[str, tuple[float, float]] = {}
    for number, names in enumerate(lines):
        left = (COLUMNS - len(names)) * across / 2 + GAP
        for column, name in enumerate(names):
            places[name] = (left + column * across, GAP + number * ROW)
    size = (COLUMNS * across + GAP, len(lines) * ROW)
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {size[0]} {size[1]}" '
        'font-family="sans-serif" font-size="11">',
        f'<rect width="{size[0]}" height="{size[1]}" fill="white"/>',
    ]
    ground = {name for name, row in heights(arrows).items() if row == 0}
    for name, others in reduced(arrows).items():
        x, y = places[name]
        for other in sorted(others - ground):
            to_x, to_y = places[other]
            start = (x + WIDTH / 2, y + HEIGHT)
            end = (to_x + WIDTH / 2, to_y)
            bend = (start[1] + end[1]) / 2
            parts.append(
                f'<path d="M{start[0]} {start[1]} C{start[0]} {bend} {end[0]} {bend} '
                f'{end[0]} {end[1]}" fill="none" stroke="#9aa7b2"/>'
            )
    for name, (x, y) in places.items():
        color = "#e6f0e4" if name.startswith("qgs_") else "#e7eef6"
        parts.append(
            f'<rect x="{x}" y="{y}" width="{WIDTH}" height="{HEIGHT}" rx="6" fill="{color}" '
            'stroke="#5b6b79"/>'
            f'<text x="{x + WIDTH / 2}" y="{y + 21}" text-anchor="middle" font-weight="bold" '
            f'font-size="13">{name}</text>'
            f'<text x="{x + WIDTH / 2}" y="{y + 38}" text-anchor="middle" fill="#44525e">'
            f"{escape(title(files[name]))}</text>"
        )
    return "\n".join([*parts, "</svg>\n"])


if __name__ == "__main__":
    PICTURE.write_text(drawn(), encoding="utf-8")
