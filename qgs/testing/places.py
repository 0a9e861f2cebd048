"""Where in a component's own code an error was raised."""

from __future__ import annotations

import traceback
from pathlib import Path

import torch

from qgs.composer.registry import lies_in, package_of
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
    theirs = [f for f in frames if not lies_in(f.filename, SUITE)]
    own = [f for f in theirs if root is not None and lies_in(f.filename, root)]
    others = [f for f in theirs if not lies_in(f.filename, TORCH)]
    place = (own[-1:] or others[:1] or frames[-1:])[0]
    what = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
    return f"{what} (raised under {place.filename}:{place.lineno})"
