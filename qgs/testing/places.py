"""Where in a component's own code an error was raised."""

from __future__ import annotations

import sys
import traceback
from pathlib import Path

import torch

from qgs.testing.faults import ElsewhereError

SUITE = Path(__file__).parent
TORCH = Path(torch.__file__).parent


def raised(error: BaseException, file: str | None) -> str:
    """Type and message of `error`, and the place of it that the author of a component can mend.

    file: that defines the component, None for none. The place is the last one in its package; for
    an error that never passed there the first one outside of this suite and of torch, else the last
    of all.
    """
    if isinstance(error, ElsewhereError):
        return str(error)
    frames = traceback.extract_tb(error.__traceback__)
    root = package_of(file) if file else None
    theirs = [f for f in frames if not _lies_in(f.filename, SUITE)]
    own = [f for f in theirs if root is not None and _lies_in(f.filename, root)]
    others = [f for f in theirs if not _lies_in(f.filename, TORCH)]
    place = (own[-1:] or others[:1] or frames[-1:])[0]
    what = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
    return f"{what} (raised under {place.filename}:{place.lineno})"


def file_of(component: type) -> str | None:
    """The file that defines a class; None for one that was defined in no file."""
    return getattr(sys.modules.get(component.__module__), "__file__", None)


def package_of(file: str) -> Path:
    """The outermost package folder that holds the module `file`, or the file itself."""
    path = Path(file).resolve()
    while (path.parent / "__init__.py").exists():
        path = path.parent
    return path


def _lies_in(file: str, root: Path) -> bool:
    path = Path(file).resolve()
    return path == root or root in path.parents
