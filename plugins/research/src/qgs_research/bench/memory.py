"""Peak memory of one operation, in a process that does nothing else: this module, run by itself."""

import json
import subprocess
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from qgs.recipe import Recipe, resolve
from qgs_research.bench.work import Operation, Workload, make_task


@dataclass(frozen=True)
class Peak:
    """peak_bytes: on the CPU the largest resident set of the whole process; on a GPU the most that
    torch had allocated. idle_bytes: before the model was built."""

    peak_bytes: int
    idle_bytes: int


def peak_memory(recipe: Recipe, operation: Operation, workload: Workload, threads: int) -> Peak:
    """Build the model in a fresh process, run `operation` there, and return the peak.

    Raises ChildProcessError, with the last output of the process, when it failed or was killed.
    """
    order = json.dumps([dict(recipe.tree), operation, asdict(workload), threads])
    command = [sys.executable, "-m", "qgs_research.bench.memory"]
    done = subprocess.run(command, input=order, capture_output=True, text=True)
    if not done.returncode:
        return Peak(**json.loads(done.stdout))
    what = f"the process that measured the memory of the {operation}"
    if done.returncode == -9:
        raise ChildProcessError(
            f"{what} was killed (SIGKILL), most likely because the machine has too little: choose "
            "fewer or smaller views, or a smaller batch or model"
        )
    last = done.stderr.strip().splitlines()[-1:] or ["nothing"]
    raise ChildProcessError(
        f"{what} ended with {done.returncode}: {last[0]}; without --memory the error has its "
        "traceback"
    )


def measure(
    tree: dict[str, Any], operation: Operation, workload: dict[str, Any], threads: int
) -> Peak:
    """The peak of this process; see `peak_memory`."""
    torch.set_num_threads(threads)
    work = Workload(**{**workload, "size": tuple(workload["size"])})
    recipe = resolve(tree)
    on_gpu = work.device == "cuda"
    idle = 0 if on_gpu else resident_bytes("VmRSS")
    task = make_task(operation, recipe, recipe.build_model(work.device), work)
    if operation == "step":  # the first one makes the optimiser's moments and compiles kernels
        task()
        restart = Path("/proc/self/clear_refs")
        if on_gpu:
            torch.cuda.reset_peak_memory_stats()
        elif restart.exists():  # on Linux
            restart.write_text("5")
    task()
    return Peak(torch.cuda.max_memory_allocated() if on_gpu else resident_bytes("VmHWM"), idle)


def resident_bytes(field: str) -> int:
    """Bytes resident now (VmRSS) or at most so far (VmHWM); the latter for both outside Linux."""
    status = Path("/proc/self/status")
    if status.exists():
        lines = status.read_text().splitlines()
        (kibibytes,) = (line.split()[1] for line in lines if line.startswith(f"{field}:"))
        return int(kibibytes) * 1024
    import resource  # Windows has none; on Linux it would count the parent of a spawned process

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


if __name__ == "__main__":
    json.dump(asdict(measure(*json.load(sys.stdin))), sys.stdout)
