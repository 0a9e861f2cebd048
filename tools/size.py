"""Size of the Python code in this repository, by group; tests/test_quality.py sets limits.

    python tools/size.py

tokens: number of tokens of code. Comments, docstrings, line ends and indentation do not count, so
the layout of lines does not matter. parallel: assignments such as `a, b = x, y` per 1,000 lines,
in files without kernels of numba or Triton. why: percentage of lines that hold only a comment.
"""

import ast
import io
import subprocess
import tokenize
from collections import Counter, defaultdict
from pathlib import Path

ROOT = Path(__file__).parents[1]
LAYOUT = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
    tokenize.ENCODING,
}
KERNELS = ("@jit", "@kernel", "numba", "triton.jit")


def group_of(path: str) -> str:
    """Return the group of a file: qgs, plugins, tests, tools, docs or other.

    path: path of the file, relative to the repository.
    """
    parts = path.split("/")
    if "tests" in parts or path == "conftest.py":
        return "tests"
    return parts[0] if parts[0] in ("qgs", "plugins", "tools", "docs") else "other"


def is_docstring(node: ast.AST) -> bool:
    """Return True if a statement is a docstring, of a module, class, function or name."""
    value = node.value if isinstance(node, ast.Expr) else None
    return isinstance(value, ast.Constant) and isinstance(value.value, str)


def is_parallel(node: ast.AST) -> bool:
    """Return True if a statement assigns several values at once, such as `a, b = x, y`."""
    if not isinstance(node, ast.Assign):
        return False
    return isinstance(node.targets[0], ast.Tuple) and isinstance(node.value, ast.Tuple)


def measure(text: str) -> Counter[str]:
    """Count tokens, lines and other quantities of a file with content `text`, by name."""
    documented: set[int] = set()
    parallel = 0
    for node in ast.walk(ast.parse(text)):
        parallel += is_parallel(node)
        if is_docstring(node):
            documented |= set(range(node.lineno, node.end_lineno + 1))  # type: ignore[attr-defined]
    tokens = sum(
        token.type not in LAYOUT and token.start[0] not in documented
        for token in tokenize.generate_tokens(io.StringIO(text).readline)
    )
    lines = text.splitlines()
    plain = not any(word in text for word in KERNELS)
    return Counter(
        tokens=tokens,
        lines=len(lines),
        files=1,
        comments=sum(line.strip().startswith("#") for line in lines),
        parallel=parallel * plain,
        plain_lines=len(lines) * plain,
    )


def sources() -> dict[str, str]:
    """Return the contents of all Python files that git tracks, by path."""
    listed = subprocess.check_output(["git", "-C", ROOT, "ls-files", "*.py"], text=True)
    names = [name for name in listed.split() if (ROOT / name).is_file()]
    return {name: (ROOT / name).read_text("utf-8") for name in names}


def sizes() -> dict[str, dict[str, float]]:
    """Return what `measure` counts, parallel and why of each group, and of the group `all`."""
    groups: dict[str, Counter[str]] = defaultdict(Counter)
    for name, text in sources().items():
        counts = measure(text)
        groups[group_of(name)] += counts
        groups["all"] += counts
    return {
        group: {
            **counts,
            "parallel": 1000 * counts["parallel"] / max(counts["plain_lines"], 1),
            "why": 100 * counts["comments"] / counts["lines"],
        }
        for group, counts in groups.items()
    }


def main() -> None:
    """Print a table of the groups, in descending order of size."""
    print(f"{'group':10}{'tokens':>9}{'lines':>8}{'files':>7}{'parallel':>10}{'why %':>7}")
    for group, of in sorted(sizes().items(), key=lambda item: -item[1]["tokens"]):
        counted = f"{of['tokens']:9,}{of['lines']:8,}{of['files']:7}"
        print(f"{group:10}{counted}{of['parallel']:10.1f}{of['why']:7.1f}")


if __name__ == "__main__":
    main()
