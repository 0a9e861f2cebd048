"""Peak memory of one operation, in a process that does nothing else."""

import sys
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import get_context
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

    Raises ChildProcessError when the process was killed, and what the model raises in it.
    """
    # Spawned: a forked process would begin with the memory of this one.
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        try:
            return pool.submit(measure, dict(recipe.tree), operation, workload, threads).result()
        except BrokenProcessPool:
            raise ChildProcessError(
                f"the process that measured the memory of the {operation} was killed, most likely "
                "because the machine has too little: choose fewer or smaller views, or a smaller "
                "batch or model"
            ) from None


def measure(tree: dict[str, Any], operation: Operation, workload: Workload, threads: int) -> Peak:
    """Return the peak of this process; see `peak_memory`."""
    torch.set_num_threads(threads)
    recipe = resolve(tree)
    on_gpu = workload.device == "cuda"
    idle = 0 if on_gpu else resident_bytes("VmRSS")
    task = make_task(operation, recipe, recipe.build_model(workload.device), workload)
    if operation == "step":
        # The first step makes the optimiser's moments and compiles kernels: count from the second.
        task()
        restart = Path("/proc/self/clear_refs")
        if on_gpu:
            torch.cuda.reset_peak_memory_stats()
        elif restart.exists():  # on Linux
            restart.write_text("5")
    task()
    peak = torch.cuda.max_memory_allocated() if on_gpu else resident_bytes("VmHWM")
    return Peak(peak_bytes=peak, idle_bytes=idle)


def resident_bytes(field: str) -> int:
    """Bytes resident now (VmRSS) or at most so far (VmHWM); the latter for both outside Linux."""
    status = Path("/proc/self/status")
    if status.exists():
        lines = status.read_text().splitlines()
        (kibibytes,) = (line.split()[1] for line in lines if line.startswith(f"{field}:"))
        return int(kibibytes) * 1024
    # Imported here: Windows has none, and on Linux it would count the parent of the process.
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024
