"""House rules that a machine can check and no linter does: sizes, no machine's paths."""

import re
from collections.abc import Iterator
from pathlib import Path

import size

ROOT = Path(__file__).parents[1]
SOURCES = ("qgs", "plugins", "tests", "tools", "docs/examples")
TEXTS = (*SOURCES, "docs", "recipes", ".ci")
MAX_LINES = 600
MAX_TOKENS = {"qgs": 120_400, "plugins": 253_050, "tests": 189_700, "tools": 38_500}
"""Tokens of Python by group, as `python tools/size.py` counts them: what was reached, no more."""
MACHINE_PATH = re.compile(r"(?<![\w.$}])/(?:home|root|work|Users|opt|mnt|tmp)/\w")


def files(directories: tuple[str, ...], suffixes: set[str]) -> Iterator[Path]:
    for directory in directories:
        for path in sorted((ROOT / directory).rglob("*")):
            if path.is_file() and path.suffix in suffixes and "__pycache__" not in path.parts:
                yield path


def test_files_are_short() -> None:
    lengths = {
        str(path.relative_to(ROOT)): len(path.read_text(encoding="utf-8").splitlines())
        for path in files(SOURCES, {".py"})
    }
    long = {name: lines for name, lines in lengths.items() if lines > MAX_LINES}
    assert long == {}, f"more than {MAX_LINES} lines: divide by subject, one a file"


def test_sizes_only_fall() -> None:
    tokens = {group: counts["tokens"] for group, counts in size.sizes().items()}
    above = {group: tokens[group] for group, most in MAX_TOKENS.items() if tokens[group] > most}
    assert above == {}, "tokens above MAX_TOKENS: remove as much as you add; limits only fall"


def lines_with(pattern: re.Pattern[str]) -> list[str]:
    """FILE:LINE: TEXT of lines that match, in all texts of the repository."""
    suffixes = {"", ".py", ".md", ".yaml", ".yml", ".toml", ".sh", ".jinja"}
    at_root = [path for path in sorted(ROOT.iterdir()) if path.is_file() and path.name != ".git"]
    assert ROOT / "README.md" in at_root
    return [
        f"{path.relative_to(ROOT)}:{number}: {line.strip()}"
        for path in [*at_root, *files(TEXTS, suffixes)]
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1)
        if pattern.search(line)
    ]


def test_no_path_of_one_machine() -> None:
    assert lines_with(MACHINE_PATH) == [], "write a relative path, or one below `~`"
