"""House rules that a machine can check: layers, style, types, file length, no machine's paths."""

import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOURCES = ("qgs", "plugins", "tests", "tools", "docs/examples")
TEXTS = (*SOURCES, "docs", "recipes", ".ci")
MAX_LINES = 600
MAX_CORE_LINES, MAX_CORE_FILES, MAX_LINES_OF_CORE_TESTS = 17_698, 130, 14_600
MACHINE_PATH = re.compile(r"(?<![\w.$}])/(?:home|root|work|Users|opt|mnt|tmp)/\w")


def files(directories: tuple[str, ...], suffixes: set[str]) -> Iterator[Path]:
    for directory in directories:
        for path in sorted((ROOT / directory).rglob("*")):
            if path.is_file() and path.suffix in suffixes and "__pycache__" not in path.parts:
                yield path


def check(*command: str) -> None:
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    if result.returncode:
        pytest.fail(result.stdout + result.stderr, pytrace=False)


def test_imports_follow_the_layers() -> None:
    check(str(Path(sys.executable).with_name("lint-imports")), "--no-cache")


def test_lint() -> None:
    check(sys.executable, "-m", "ruff", "check", *SOURCES)


def test_format() -> None:
    check(sys.executable, "-m", "ruff", "format", "--check", *SOURCES)


def test_types() -> None:
    check(sys.executable, "-m", "basedpyright", "--pythonpath", sys.executable)


def test_files_are_short_and_sizes_only_fall() -> None:
    """The limits are the sizes that were reached; they are lowered, never raised.

    Only the core has some: what is new goes into plugins, which may grow.
    """
    lengths = {
        str(path.relative_to(ROOT)): len(path.read_text(encoding="utf-8").splitlines())
        for path in files(SOURCES, {".py"})
    }
    assert {name: lines for name, lines in lengths.items() if lines > MAX_LINES} == {}
    core = [lines for name, lines in lengths.items() if name.startswith("qgs/")]
    assert 0 < len(core) <= MAX_CORE_FILES
    assert sum(core) <= MAX_CORE_LINES
    tests = [lines for name, lines in lengths.items() if name.startswith("tests/")]
    assert 0 < sum(tests) <= MAX_LINES_OF_CORE_TESTS


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
    assert lines_with(MACHINE_PATH) == []
