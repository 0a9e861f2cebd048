"""Peak memory of one operation, in a process that does nothing else."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import asdict, dataclass

from qgs.composer import Recipe
from qgs.engine.bench.work import Operation, Workload


@dataclass(frozen=True)
class Peak:
    """peak_bytes: on the CPU the largest resident set of a process, interpreter and libraries
    included; on a GPU the most that torch had allocated. idle_bytes: before the model was built.
    """

    peak_bytes: int
    idle_bytes: int


def peak_memory(recipe: Recipe, operation: Operation, workload: Workload, threads: int) -> Peak:
    """Build the model in a fresh process, run `operation` there, and tell the peak.

    Raises ChildProcessError, with what the process said last, when it failed or was killed.
    """
    order = {
        "tree": dict(recipe.tree),
        "operation": operation,
        "workload": asdict(workload),
        "threads": threads,
    }
    command = [sys.executable, "-m", "qgs.engine.bench.worker"]
    done = subprocess.run(command, input=json.dumps(order), capture_output=True, text=True)
    if done.returncode:
        raise ChildProcessError(_failure(operation, done.returncode, done.stderr))
    return Peak(**json.loads(done.stdout))


def _failure(operation: Operation, code: int, said: str) -> str:
    if code == -9:
        return (
            f"the process that measured the memory of the {operation} was killed (SIGKILL), most "
            "likely because the machine has too little: choose fewer or smaller views, or a "
            "smaller batch or model"
        )
    last = said.strip().splitlines()[-1:] or ["nothing"]
    return (
        f"the process that measured the memory of the {operation} ended with {code}: {last[0]}; "
        "without --memory the error has its traceback"
    )
