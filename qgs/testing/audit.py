"""Watching what a piece of code does outside of its process."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

EVENTS = (
    "open",
    "socket.connect",
    "socket.getaddrinfo",
    "subprocess.Popen",
    "os.system",
    "os.exec",
)
CODE = (".py", ".pyc", ".so", ".pyd", ".dll", ".dylib")

_watches: list[tuple[str, list[str]]] = []
_installed = False


@contextmanager
def watched(file: str) -> Iterator[list[str]]:
    """Collect what the code of the package of `file` itself opens, connects to or starts.

    Reading code is no event, and neither is what another package does when it is imported.
    """
    global _installed
    if not _installed:
        sys.addaudithook(_hook)  # cannot be taken out again; it is idle outside of watches
        _installed = True
    events: list[str] = []
    _watches.append((root_of(file), events))
    try:
        yield events
    finally:
        _watches.pop()


def root_of(file: str) -> str:
    """The folder of the package that `file` belongs to, or `file` itself."""
    path = Path(file).resolve()
    return str(path.parent if (path.parent / "__init__.py").exists() else path)


def _hook(event: str, arguments: tuple[Any, ...]) -> None:
    if not _watches or event not in EVENTS:
        return
    if event == "open" and str(arguments[0]).endswith(CODE):
        return
    root, events = _watches[-1]
    if _is_done_by(root, sys._getframe(1)):
        events.append(f"{event} {arguments[0]!r}")


def _is_done_by(root: str, frame: FrameType | None) -> bool:
    """Whether the code of `root` acts here, and not a module that it imports."""
    while frame is not None:
        file = frame.f_code.co_filename
        if file.startswith(root):
            return True
        if file.startswith("<frozen importlib"):
            return False
        frame = frame.f_back
    return False
