"""Claims: which process has a run, so that any number of machines can share a folder.

The claims of a run are numbered files beside its folder. Making the next number is atomic on every
file system, so of several processes that find the last one dead, one wins; nothing is ever locked
or deleted while others may look at it.
"""

import json
import os
import re
import socket
import threading
from collections.abc import Callable
from pathlib import Path

from qgs_studies.plan import Run

BEAT_SECONDS = 10.0
STALE_SECONDS = 180.0
"""A claim of another machine whose heart has not beaten for so long is that of a dead one."""


class Claim:
    """What this process holds of one run. Its heart beats in a thread, until `release`.

    lost: called in that thread when another process took the run over, which happens when this
    one was stopped for minutes.
    """

    def __init__(self, path: Path, lost: Callable[[], None]) -> None:
        self._path, self._lost = path, lost
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._beat, daemon=True)
        self._thread.start()

    def release(self) -> None:
        """Leave the run to others."""
        self._over.set()
        self._thread.join()
        _rewrite(self._path, {"released": True})

    def _beat(self) -> None:
        while not self._over.wait(BEAT_SECONDS):
            try:
                newer = _numbered(self._path.parent, _stem(self._path))
                if not newer or newer[-1] == self._path:
                    os.utime(self._path)
                    continue
            except OSError:  # a shared file system may be away for some seconds
                continue
            self._lost()
            return


def take(run: Run, lost: Callable[[], None]) -> Claim | None:
    """Claim `run` for this process; None where a living one has it."""
    stem = run.folder.name
    run.folder.parent.mkdir(parents=True, exist_ok=True)
    claims = _numbered(run.folder.parent, stem)
    if claims and alive(claims[-1]):
        return None
    number = 1 + (_number(claims[-1]) if claims else 0)
    path = run.folder.with_name(f"{stem}.claim-{number}")
    try:
        file = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666)
    except FileExistsError:  # another process was faster
        return None
    with os.fdopen(file, "w", encoding="utf-8") as stream:
        json.dump({"host": host(), "pid": os.getpid()}, stream)
    if _numbered(run.folder.parent, stem)[-1] != path:  # made of a list that was old by then
        path.unlink()
        return None
    for old in claims[:-1]:  # the last one stays, for those who have just read its number
        old.unlink(missing_ok=True)
    return Claim(path, lost)


def owner(run: Run) -> str | None:
    """Who has `run`, as "pid 7 on host"; None where nobody that lives does."""
    claims = _numbered(run.folder.parent, run.folder.name)
    if not claims or not alive(claims[-1]):
        return None
    told = _read(claims[-1])
    return f"pid {told.get('pid', '?')} on {told.get('host', '?')}"


def alive(claim: Path) -> bool:
    """Whether the process behind `claim` still has it."""
    told = _read(claim)
    if told.get("released"):
        return False
    if told.get("host") == host() and isinstance(pid := told.get("pid"), int):
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return False
        except PermissionError:
            pass
    return _age(claim) < STALE_SECONDS


def host() -> str:
    """This machine; containers of one machine count as several, as they see other processes."""
    space = Path("/proc/self/ns/pid")
    return f"{socket.gethostname()}/{os.readlink(space)}" if space.exists() else os.uname().nodename


def _age(path: Path) -> float:
    """Seconds since the file was touched, by the clock of its file system."""
    probe = path.with_name(f".{path.name}.{os.getpid()}.{threading.get_ident()}.tmp")
    try:
        probe.touch()
        return probe.stat().st_mtime - path.stat().st_mtime
    except FileNotFoundError:
        return float("inf")
    finally:
        probe.unlink(missing_ok=True)


def _read(path: Path) -> dict[str, object]:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):  # killed between making and writing it: its age tells
        return {}
    return found if isinstance(found, dict) else {}


def _rewrite(path: Path, content: dict[str, object]) -> None:
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    temporary.write_text(json.dumps(content), encoding="utf-8")
    temporary.replace(path)


def _numbered(folder: Path, stem: str) -> list[Path]:
    """Claims of a run, in their order."""
    found = folder.glob(f"{stem}.claim-*") if folder.is_dir() else ()
    sound = [path for path in found if re.fullmatch(rf"{re.escape(stem)}\.claim-\d+", path.name)]
    return sorted(sound, key=_number)


def _number(path: Path) -> int:
    return int(path.name.rpartition("-")[2])


def _stem(path: Path) -> str:
    return path.name.rpartition(".claim-")[0]
