"""Where in a component's own code an error was raised."""

from __future__ import annotations

import sys
import traceback
from pathlib import Path

import torch

SUITE = Path(__file__).parent
TORCH = Path(torch.__file__).parent


def raised(error: Exception, component: type) -> str:
    """Type and message of `error`, and the place of it that the author of `component` can mend.

    That is the last place in the package of the component; for an error that never passed there
    the first one outside of this suite and of torch, else the last of all.
    """
    frames = traceback.extract_tb(error.__traceback__)
    root = package_of(component)
    theirs = [f for f in frames if not _lies_in(f.filename, SUITE)]
    own = [f for f in theirs if root is not None and _lies_in(f.filename, root)]
    others = [f for f in theirs if not _lies_in(f.filename, TORCH)]
    place = (own[-1:] or others[:1] or frames[-1:])[0]
    what = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
    return f"{what} (raised under {place.filename}:{place.lineno})"


def package_of(component: type) -> Path | None:
    """The outermost package folder that holds the module of `component`, or the module's file.

    None for a class that was defined in no file.
    """
    file = getattr(sys.modules.get(component.__module__), "__file__", None)
    if file is None:
        return None
    path = Path(file).resolve()
    while (path.parent / "__init__.py").exists():
        path = path.parent
    return path


def _lies_in(file: str, root: Path) -> bool:
    path = Path(file).resolve()
    return path == root or root in path.parents
