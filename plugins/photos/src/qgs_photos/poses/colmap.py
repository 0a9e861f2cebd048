"""COLMAP in another process: its progress, its end, and what it refuses."""

import json
import re
import subprocess
import sys
from collections import deque
from collections.abc import Callable
from dataclasses import asdict

from qgs_photos.poses.job import FEATURES, MATCHING, Job
from qgs_photos.poses.photos import ColmapError

REFUSALS = {
    "features": (
        "fewer than three of {photos} have enough points to match: they are blurred, or what they "
        "show is bare. Take sharp ones of something with texture"
    ),
    "overlap": (
        "no poses: of {photos}, {pairs} pairs share enough points. Take more photos, a step apart, "
        "so that each shows half of what the one before shows"
    ),
    "motion": (
        "no poses: {photos} match, but no two of them show the same from places far enough apart. "
        "Walk around what you take, do not turn on the spot, and take more photos"
    ),
}
"""Why the process went no further, by the word of its result."""

# Of COLMAP's log, kept for a crash.
_LINES = 30
# Lines of its log by which progress is told: features, neighbours, blocks of pairs.
_FILE = re.compile(r"Processed file \[\d+/\d+\]")
_IMAGE = re.compile(r"Processing image \[(\d+)/(\d+)\]")
_BLOCK = re.compile(r"Processing block \[(\d+)/(\d+), (\d+)/(\d+)\]")


class Log:
    """The log of the process: how far it is. stage, done, total: of the last line."""

    def __init__(self, total: int) -> None:
        self.stage = FEATURES
        self.done = 0
        self.total = total
        self.last = deque[str](maxlen=_LINES)

    def read(self, line: str) -> None:
        """Take a line in."""
        if line.startswith("{"):
            self.stage, self.done, self.total = json.loads(line).values()
            return
        self.last.append(line.rstrip())
        if _FILE.search(line):
            self.done = min(self.done + 1, self.total)
        elif self.stage == MATCHING and (found := _IMAGE.search(line)):
            done, self.total = map(int, found.groups())
            self.done = done - 1
        elif self.stage == MATCHING and (found := _BLOCK.search(line)):
            row, rows, column, columns = map(int, found.groups())
            self.done = (row - 1) * columns + column - 1
            self.total = rows * columns

    def crash(self, code: int) -> str:
        """Return a sentence on a process that ended with `code`."""
        # glog begins errors by E or F and the date
        errors = [line for line in self.last if re.match("[EF]\\d{8}|.*Error", line)]
        reason = (errors or [*self.last] or ["it logged nothing"])[-1]
        how = f"signal {-code}" if code < 0 else f"exit code {code}"
        return (
            f"COLMAP ended in the stage {self.stage!r} by {how} ({reason[:200]}): repeat the "
            "command, which goes on from there, with a smaller --side where memory is short"
        )


def run(job: Job, photos: int, show: Callable[[str, int, int], None]) -> None:
    """Do `job` in a process of its own. Raises ColmapError where that ends early.

    show: called with stage, what is done and what there is.
    """
    # a failed check of COLMAP ends its process: it must not be that of the command
    process = subprocess.Popen(
        [sys.executable, "-m", "qgs_photos.poses.worker"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        encoding="utf-8",
        errors="replace",
        # Ctrl-C reaches this process alone, which ends the other
        start_new_session=True,
    )
    assert process.stdin is not None
    assert process.stdout is not None
    log = Log(photos)
    try:
        process.stdin.write(json.dumps(asdict(job)) + "\n")
        process.stdin.flush()
        for line in process.stdout:
            log.read(line)
            show(log.stage, log.done, log.total)
        process.wait()
    # whatever ends the loop, Ctrl-C too, must not leave a process behind
    finally:
        process.kill()
        process.wait()
        process.stdin.close()
        process.stdout.close()
    if process.returncode:
        raise ColmapError(log.crash(process.returncode))
