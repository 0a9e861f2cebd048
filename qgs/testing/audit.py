"""Watching what a piece of code does outside of its process."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from threading import get_ident
from types import FrameType
from typing import Any

from qgs.testing.unaudited import UNAUDITED, audited

EVENTS = frozenset(UNAUDITED) | {
    "open",
    "os.chmod",
    "os.chown",
    "os.link",
    "os.listdir",
    "os.mkdir",
    "os.remove",
    "os.rename",
    "os.rmdir",
    "os.scandir",
    "os.symlink",
    "os.truncate",
    "os.utime",
    "sqlite3.connect",
    "socket.bind",
    "socket.connect",
    "socket.getaddrinfo",
    "socket.gethostbyname",
    "socket.sendto",
    "os.exec",
    "os.fork",
    "os.posix_spawn",
    "os.system",
    "subprocess.Popen",
}
"""Files, connections and processes. `shutil`, `tempfile` and `glob` come down to these."""

SUITE = str(Path(__file__).parent)

WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND

CODE = (".py", ".pyc", ".so", ".pyd", ".dll", ".dylib")


@dataclass(frozen=True)
class Deed:
    """Something done outside of the process. files: of the code that did it, outermost last."""

    text: str
    files: tuple[str, ...]

    def is_done_by(self, package: Path) -> bool:
        """Whether code of the folder or file `package` did it, or what that code called."""
        return any(Path(file).resolve().is_relative_to(package) for file in self.files)


@dataclass(frozen=True)
class _Watch:
    """Deeds seen so far, and the thread whose code is watched."""

    deeds: list[Deed]
    thread: int


_watches: list[_Watch] = []
_installed = False


@contextmanager
def watched() -> Iterator[list[Deed]]:
    """Collect what is opened, connected to or started.

    Reading code is no deed, and what a module does when it is imported is none of the importer's.
    What another thread does meanwhile is done by the code that the watched thread is in too: it
    waits there for a pool.
    """
    global _installed
    if not _installed:
        sys.addaudithook(_hook)  # cannot be taken out again; it is idle outside of watches
        _installed = True
    deeds: list[Deed] = []
    with audited():
        _watches.append(_Watch(deeds, get_ident()))
        try:
            yield deeds
        finally:
            _watches.pop()


def _hook(event: str, arguments: tuple[Any, ...]) -> None:
    if not _watches or event not in EVENTS:
        return
    what = arguments[0] if arguments else ""
    what = os.fspath(what) if isinstance(what, os.PathLike) else what
    if event == "open" and str(what).endswith(CODE) and _only_reads(*arguments[1:]):
        return
    watch, files = _watches[-1], [*_files(sys._getframe(1))]
    if get_ident() != watch.thread:
        files += _files(sys._current_frames().get(watch.thread))
    watch.deeds.append(Deed(f"{event} {what!r}", tuple(files)))


def _only_reads(mode: str | None, flags: int) -> bool:
    """Of the arguments of the audit event `open`: those of `open`, or of `os.open` without mode."""
    return not set(mode or "") & set("wax+") and not flags & WRITING


def _files(frame: FrameType | None) -> Iterator[str]:
    """Files of the code that acts here, as far as the import statement that runs it.

    This suite's own are none of them.
    """
    while frame is not None and not frame.f_code.co_filename.startswith("<frozen importlib"):
        if not frame.f_code.co_filename.startswith(("<", SUITE)):
            yield frame.f_code.co_filename
        frame = frame.f_back
