"""How many lines of a plugin are mathematics, options, declarations, registration or imports.

    python tools/plugin_lines.py plugins/ellipsoid/src

Counts lines of code: no blank ones, comments or docstrings. Of a component, `name`, `requires`,
`provides` and the heads of classes and constructors are declarations; the fields of its Config and
`problems`, which refuses them, are options. Field specs are the state. What is left is mathematics.
"""

from __future__ import annotations

import argparse
import ast
import io
import tokenize
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

DECLARING = ("requires", "provides")
NO_CODE = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
}


def code_lines(source: str) -> set[int]:
    """Numbers of the lines that hold code."""
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    spans = [(t.start[0], t.end[0]) for t in tokens if t.type not in NO_CODE]
    lines = {line for first, last in spans for line in range(first, last + 1)}
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            lines -= set(_lines(node))
    return lines


def purposes(source: str, is_package: bool) -> dict[int, str]:
    """Line number to purpose, for the lines that are no mathematics."""
    found: dict[int, str] = {}
    for node in ast.parse(source).body:
        if isinstance(node, ast.Import | ast.ImportFrom):
            found |= dict.fromkeys(_lines(node), "imports")
        elif is_package:
            found |= dict.fromkeys(_lines(node), "registration")
        elif _declares_state(node):
            found |= dict.fromkeys(_lines(node), "state")
        elif isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            found |= _of_component(node)
    return found


def _of_component(node: ast.ClassDef) -> dict[int, str]:
    found = {node.lineno: "declarations"}
    for member in node.body:
        match member:
            case ast.FunctionDef(name=name) if name in DECLARING:
                found |= dict.fromkeys(_lines(member), "declarations")
            case ast.FunctionDef(name="problems"):
                found |= dict.fromkeys(_lines(member), "options")
            case ast.FunctionDef(name="__init__"):
                found |= dict.fromkeys((member.lineno, member.body[0].lineno), "declarations")
            case ast.AnnAssign(target=ast.Name(id="name" | "config")):
                found |= dict.fromkeys(_lines(member), "declarations")
            case ast.ClassDef(name="Config"):
                found |= dict.fromkeys(_lines(member), "options") | {member.lineno: "declarations"}
    return found


def _declares_state(node: ast.stmt) -> bool:
    """Whether it defines the name of a state field or its FieldSpec."""
    if isinstance(node, ast.Assign):
        return isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
    said = node.returns if isinstance(node, ast.FunctionDef) else None
    said = node.annotation if isinstance(node, ast.AnnAssign) else said
    return isinstance(said, ast.Name) and said.id == "Fields"


def _lines(node: ast.AST) -> Iterator[int]:
    assert isinstance(node, ast.stmt)
    decorators = [d.lineno for d in getattr(node, "decorator_list", [])]
    last = node.end_lineno or node.lineno
    return iter(range(min([node.lineno, *decorators]), last + 1))


def counted(path: Path) -> Counter[str]:
    """Lines of code of a file by purpose."""
    source = path.read_text(encoding="utf-8")
    known = purposes(source, path.name == "__init__.py")
    return Counter(known.get(line, "mathematics") for line in code_lines(source))


def main() -> None:
    parser = argparse.ArgumentParser(description="What the lines of a plugin are for.")
    parser.add_argument("folder", type=Path, help="the plugin's src")
    folder = parser.parse_args().folder
    files = {path.name: counted(path) for path in sorted(folder.rglob("*.py"))}
    if not files:
        parser.error(f"there is no Python file under {folder}")
    for name, lines in {**files, "in all": sum(files.values(), Counter())}.items():
        print(f"{name:22}", ", ".join(f"{n} {kind}" for kind, n in lines.most_common()))


if __name__ == "__main__":
    main()
