"""Places in a plugin's own code: where an error was raised, where a function is."""

from __future__ import annotations

import inspect
import sys
import traceback
from collections.abc import Callable, Iterable
from importlib.util import find_spec
from pathlib import Path
from typing import Any


def file_of(component: type) -> str | None:
    """The file that defines a class; None for one that was defined in no file."""
    return getattr(sys.modules.get(component.__module__), "__file__", None)


def package_of(file: str) -> Path:
    """The outermost package folder that holds the module `file`, or the file itself."""
    path = Path(file).resolve()
    while (path.parent / "__init__.py").exists():
        path = path.parent
    return path


def package_named(module: str) -> list[Path]:
    """The folder, or the file, of the outermost package of `module`, which need not import."""
    try:
        spec = find_spec(module.partition(".")[0])
    except (ImportError, ValueError):
        return []
    return [package_of(spec.origin)] if spec and spec.origin else []


def lies_in(file: str, root: Path) -> bool:
    """Whether `file` is `root` or below it."""
    path = Path(file).resolve()
    return path == root or root in path.parents


def place_of(function: Callable[..., Any]) -> str:
    """FILE:LINE where a function starts; "" for one that is not written in Python."""
    code = getattr(inspect.unwrap(function), "__code__", None)
    return f"{code.co_filename}:{code.co_firstlineno}" if code else ""


def place_in(error: BaseException, roots: Iterable[Path]) -> str:
    """FILE:LINE of the last place below one of `roots` that `error` passed; "" for none."""
    frames = traceback.extract_tb(error.__traceback__)
    passed = [(frame.filename, frame.lineno) for frame in frames]
    if isinstance(error, SyntaxError) and error.filename:
        passed.append((error.filename, error.lineno))
    roots = list(roots)
    own = [place for place in passed if any(lies_in(place[0], root) for root in roots)]
    return "{}:{}".format(*own[-1]) if own else ""
