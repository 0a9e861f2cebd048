"""Run COLMAP in another process, show its progress and report its errors."""

import json
import re
import subprocess
import sys
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from qgs_photos.poses.job import Job
from qgs_photos.poses.photos import PosesError, Show

# Of COLMAP's log, kept for a crash.
_LINES = 30
# Lines of its log by which progress is told: features, neighbours, blocks of pairs.
_STEP = re.compile(r"Process(?:ed file|ing image|ing block) \[(\d+)/(\d+)")


def run(job: Job, show: Show) -> tuple[Mapping[str, int], Sequence[str]]:
    """Run `job` in a separate process; return the points of each photo with a pose, and remarks.

    show: called with the stage, the number of steps done and the number of all steps. Raises
    PosesError if COLMAP finds no model or its process crashes.
    """
    # a failed check of COLMAP ends its process: it must not be that of the command
    told: dict[str, Any] = {}
    last = deque[str](maxlen=_LINES)
    with subprocess.Popen(
        [sys.executable, "-m", "qgs_photos.poses.worker"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        encoding="utf-8",
        errors="replace",
        # Ctrl-C reaches this process alone, which ends the other
        start_new_session=True,
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            process.stdin.write(json.dumps(asdict(job)) + "\n")
            process.stdin.flush()
            for line in process.stdout:
                if line.startswith("{"):
                    told = json.loads(line)
                elif found := _STEP.search(line):
                    done, total = map(int, found.groups())
                    told |= {"done": done - 1, "total": total}
                else:
                    last.append(line.rstrip())
                if "stage" in told:
                    show(told["stage"], told["done"], told["total"])
            process.wait()
        # whatever ends the loop, Ctrl-C too, must not leave a process behind
        finally:
            process.kill()
    if "refused" in told:
        raise PosesError(f"poses cannot be computed: {told['refused']}")
    if code := process.returncode:
        # glog begins errors by E or F and the date
        errors = [line for line in last if re.match("[EF]\\d{8}|.*Error", line)]
        reason = (errors or [*last] or ["it logged nothing"])[-1]
        how = f"signal {-code}" if code < 0 else f"exit code {code}"
        raise PosesError(
            f"COLMAP ended in the stage {told.get('stage')!r} by {how} ({reason[:200]}): repeat "
            "the command, with a smaller --side if memory is short"
        )
    return told["posed"], told["remarks"]
