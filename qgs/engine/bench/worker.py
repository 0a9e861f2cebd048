"""The process that `qgs.engine.bench.memory` starts: an order on stdin, a peak on stdout."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from qgs.composer import resolve
from qgs.engine.bench.memory import Peak
from qgs.engine.bench.work import Operation, Workload, make_task


def measure(
    tree: dict[str, Any], operation: Operation, workload: dict[str, Any], threads: int
) -> Peak:
    """The peak of this process; see `qgs.engine.bench.memory.peak_memory`.

    Of training it is the second step's: the first one makes the optimiser's moments, and compiles
    kernels, which takes memory that no later step needs.
    """
    torch.set_num_threads(threads)
    work = Workload(**{**workload, "size": tuple(workload["size"])})
    recipe = resolve(tree)
    on_gpu = work.device == "cuda"
    idle = 0 if on_gpu else resident_bytes("VmRSS")
    task = make_task(operation, recipe, recipe.build_model(work.device), work)
    if operation == "step":
        task()
        _forget_peak(on_gpu)
    task()
    return Peak(torch.cuda.max_memory_allocated() if on_gpu else resident_bytes("VmHWM"), idle)


def resident_bytes(field: str) -> int:
    """Bytes resident now (VmRSS) or at most so far (VmHWM) of this process.

    Linux has both in /proc. Elsewhere ru_maxrss stands for both; on Linux it would count the parent
    of a spawned process.
    """
    status = Path("/proc/self/status")
    if status.exists():
        lines = status.read_text().splitlines()
        (kibibytes,) = (line.split()[1] for line in lines if line.startswith(f"{field}:"))
        return int(kibibytes) * 1024
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def _forget_peak(on_gpu: bool) -> None:
    """Start a new peak; on systems without Linux's /proc the old one stays."""
    if on_gpu:
        torch.cuda.reset_peak_memory_stats()
        return
    switch = Path("/proc/self/clear_refs")
    if switch.exists():
        switch.write_text("5")


if __name__ == "__main__":
    json.dump(asdict(measure(**json.load(sys.stdin))), sys.stdout)
