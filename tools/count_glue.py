"""How much of a plugin is glue: imports, options, declarations, as a share of its lines.

python tools/count_glue.py locus ellipsoid c3g gslrm globalsplat mvsplat landmark
"""

import ast
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

DECLARED = {
    *("name", "slot", "reads", "writes", "fields_read", "fields_written", "bandwidth_fields"),
    *("problems", "scheduled", "renderings", "sublayers"),
}
"""Attributes and methods that tell the composer what a component is."""


def glue(tree: ast.AST) -> Iterator[tuple[str, ast.stmt]]:
    """Every statement that is glue, and of which kind."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            yield "imports", node
        elif isinstance(node, ast.ClassDef) and node.name == "Config":
            yield "options", node
        elif isinstance(tree, ast.ClassDef) and names(node) & DECLARED:
            assert isinstance(node, ast.stmt)
            yield "declarations", node
        else:
            yield from glue(node)


def names(node: ast.AST) -> set[str]:
    """What a statement defines."""
    if isinstance(node, ast.FunctionDef):
        return {node.name}
    targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
    return {target.id for target in targets if isinstance(target, ast.Name)}


def count(folder: Path) -> Counter[str]:
    """Lines of all files in `folder`, and those that are glue by kind."""
    lines: Counter[str] = Counter()
    for path in folder.rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        lines["all"] += len(text.splitlines())
        for kind, node in glue(ast.parse(text)):
            decorators = getattr(node, "decorator_list", [])
            first = min([node.lineno, *(x.lineno for x in decorators)])
            lines[kind] += (node.end_lineno or first) - first + 1
    return lines


if __name__ == "__main__":
    for plugin in sys.argv[1:]:
        lines = count(Path(__file__).parents[1] / "plugins" / plugin / "src")
        kinds = {kind: lines[kind] for kind in ("imports", "options", "declarations")}
        print(f"{plugin}: {sum(kinds.values()) / lines['all']:.1%} of {lines['all']} lines {kinds}")
