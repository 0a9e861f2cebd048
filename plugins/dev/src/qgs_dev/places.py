"""Where code of a plugin stands: files of classes, places that an error passed."""

import sys
import traceback
from collections.abc import Iterable
from pathlib import Path


def file_of(component: type) -> str | None:
    """The file that defines a class; None for one that was defined in no file."""
    return getattr(sys.modules.get(component.__module__), "__file__", None)


def package_of(file: str) -> Path:
    """The outermost package folder that holds the module `file`, or the file itself."""
    path = Path(file).resolve()
    while (path.parent / "__init__.py").exists():
        path = path.parent
    return path


def place_in(error: BaseException, roots: Iterable[Path]) -> str:
    """FILE:LINE of the last place below one of `roots` that `error` passed; "" for none."""
    frames = traceback.extract_tb(error.__traceback__)
    passed = [(frame.filename, frame.lineno) for frame in frames]
    if isinstance(error, SyntaxError) and error.filename:
        passed.append((error.filename, error.lineno))
    inside = tuple(roots)
    for file, line in reversed(passed):
        if any(Path(file).resolve().is_relative_to(root) for root in inside):
            return f"{file}:{line}"
    return ""
