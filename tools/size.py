"""Size and density of the Python in this repository, by group; tests/test_quality.py has limits.

    python tools/size.py

tokens: of code, without comments, docstrings, line ends and indentation, so that folding lines
saves nothing. parallel: assignments `a, b = x, y` per 1,000 lines of files without kernels of numba
or Triton. why: lines that hold a comment of their own, as a share of lines, in percent.
"""

import ast
import io
import subprocess
import tokenize
from collections import Counter, defaultdict
from pathlib import Path

ROOT = Path(__file__).parents[1]
LAYOUT = {
    *(tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT),
    *(tokenize.ENDMARKER, tokenize.ENCODING),
}
KERNELS = ("@jit", "@kernel", "numba", "triton.jit")


def group_of(path: str) -> str:
    """qgs, plugins, tests, tools, docs or other; `path` is relative to the repository."""
    first, *rest = path.split("/")
    if "tests" in (first, *rest):
        return "tests"
    return first if first in ("qgs", "plugins", "tools", "docs") else "other"


def is_text(node: ast.AST) -> bool:
    """Whether a statement is a docstring, of a module, class, function or name."""
    value = getattr(node, "value", None)
    return (
        isinstance(node, ast.Expr)
        and isinstance(value, ast.Constant)
        and isinstance(value.value, str)
    )


def is_parallel(node: ast.AST) -> bool:
    """Whether a statement assigns several values at once."""
    return (
        isinstance(node, ast.Assign)
        and isinstance(node.targets[0], ast.Tuple)
        and isinstance(node.value, ast.Tuple)
    )


def measure(text: str) -> Counter[str]:
    """Counts of a file, by their names."""
    documented: set[int] = set()
    parallel = 0
    for node in ast.walk(ast.parse(text)):
        parallel += is_parallel(node)
        if is_text(node):
            documented |= set(range(node.lineno, node.end_lineno + 1))  # type: ignore[attr-defined]
    tokens = [
        token
        for token in tokenize.generate_tokens(io.StringIO(text).readline)
        if token.type not in LAYOUT and token.start[0] not in documented
    ]
    lines = text.splitlines()
    plain = not any(word in text for word in KERNELS)
    return Counter(
        tokens=len(tokens),
        lines=len(lines),
        files=1,
        comments=sum(line.strip().startswith("#") for line in lines),
        parallel=parallel * plain,
        plain_lines=len(lines) * plain,
    )


def sizes() -> dict[str, Counter[str]]:
    """Counts of each group, and of `all`, over the files that git knows."""
    listed = subprocess.check_output(["git", "-C", ROOT, "ls-files", "*.py"], text=True)
    groups: dict[str, Counter[str]] = defaultdict(Counter)
    for name in listed.split():
        counts = measure((ROOT / name).read_text(encoding="utf-8"))
        groups[group_of(name)] += counts
        groups["all"] += counts
    return groups


def main() -> None:
    """Print a table of the groups, the largest first."""
    print(f"{'group':10}{'tokens':>9}{'lines':>8}{'files':>7}{'parallel':>10}{'why %':>7}")
    for group, of in sorted(sizes().items(), key=lambda item: -item[1]["tokens"]):
        parallel = 1000 * of["parallel"] / max(of["plain_lines"], 1)
        why = 100 * of["comments"] / of["lines"]
        sizes_of = f"{of['tokens']:9,}{of['lines']:8,}{of['files']:7}"
        print(f"{group:10}{sizes_of}{parallel:10.1f}{why:7.1f}")


if __name__ == "__main__":
    main()
