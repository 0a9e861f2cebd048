"""What tests demand in one line: a refusal, the same bits, files as before; tables, JSON, text."""

import io
import json
from functools import partial
from pathlib import Path

import pytest
from numpy.testing import assert_allclose
from rich.console import Console
from torch.testing import assert_close

assert_equal = partial(assert_close, rtol=0, atol=0)
"""To the bit, or within `atol`, however large the numbers are."""
assert_near = partial(assert_allclose, rtol=1e-6, equal_nan=False)
"""Of a tensor and numbers."""


def must_refuse(match, function, *given, kind=ValueError, **options):
    """`function` raises `kind` with `match`, which is returned."""
    with pytest.raises(kind, match=match) as caught:
        function(*given, **options)
    return caught.value


must_not_find = partial(must_refuse, kind=FileNotFoundError)


def rows(table, mark=" | "):
    """The cells of each line."""
    return [line.split(mark) for line in table.strip().splitlines()]


def text_console():
    """A console of wide lines, whose text is that of its file."""
    return Console(file=io.StringIO(), width=300)


def contents(folder):
    """Path to bytes and time of change of every file."""
    files = filter(Path.is_file, folder.rglob("*"))
    return {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in files}


def names_in(folder):
    return {path.name for path in folder.iterdir()}


def read_json(path):
    """The content of a JSON file."""
    return json.loads(path.read_text())


def write_json(path, content):
    path.write_text(json.dumps(content))
