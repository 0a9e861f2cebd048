"""One run in a process of its own, started by the queue: lock it, train it, evaluate it.

A killed process takes nothing with it but its own run's last steps since they were saved.
"""

# What computes is imported by the functions: libraries read the number of threads when they are
# imported, and `begin` sets it before.
import os
import signal
import sys
import threading
import time
import traceback
from pathlib import Path
from typing import TYPE_CHECKING

from filelock import FileLock, Timeout

if TYPE_CHECKING:
    from qgs_research.studies.runs import Run

_WATCH_SECONDS = 1.0


def begin(log: Path, threads: int, gpu: str, parent: int) -> None:
    """Prepare this process for one run. gpu: as CUDA_VISIBLE_DEVICES names it; "" for any."""
    # A Ctrl-C in the terminal reaches the queue alone, which stops its runs once.
    os.setpgrp()
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    # The descriptors, not sys.stdout: compiled libraries print into them too.
    output = os.open(log, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
    os.dup2(output, sys.stdout.fileno())
    os.dup2(output, sys.stderr.fileno())
    for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = str(threads)
    if gpu:
        os.environ["CUDA_VISIBLE_DEVICES"] = gpu
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: int) -> None:
    """Stop, as SIGTERM does, when the queue that started this process is gone."""
    while os.getppid() == parent:
        time.sleep(_WATCH_SECONDS)
    os.kill(os.getpid(), signal.SIGTERM)


def work(
    folder: Path, variant: str, seed: int, evaluations: list[str], device: str, threads: int
) -> None:
    """Train a run of the study in `folder`, and evaluate it; what is there already is kept.

    Does nothing where another process has the run. An error is written beside the run.
    """
    import torch

    from qgs.files import write_text
    from qgs_research.studies.runs import run_of

    run = run_of(folder, variant, seed)
    try:
        # The kernel releases the lock of a process that dies, so a killed run is free at once.
        with lock_of(run):
            torch.set_num_threads(threads)
            _train_and_evaluate(folder, run, evaluations, device)
    except Timeout:
        return
    except Exception as error:
        traceback.print_exc()
        write_text(run.failure, f"{type(error).__name__}: {error}\n")


def lock_of(run: "Run") -> FileLock:
    """Return the lock of a run; entering it raises Timeout if another process has the run."""
    run.folder.parent.mkdir(parents=True, exist_ok=True)
    return FileLock(run.beside("lock"), blocking=False)


def is_free(run: "Run") -> bool:
    """Return True if no process has `run`."""
    try:
        with lock_of(run):
            return True
    except Timeout:
        return False


def _train_and_evaluate(folder: Path, run: "Run", evaluations: list[str], device: str) -> None:
    """Do what `run` lacks. Raises whatever training and evaluating raise."""
    from rich.console import Console

    from qgs.evaluate.evaluation import evaluate
    from qgs.recipe import Recipe, resolve
    from qgs.train.training import train
    from qgs_research.studies.hypotheses import MAIN
    from qgs_research.studies.runs import recipe_file

    def recipe_of(evaluation: str) -> Recipe:
        return resolve(recipe_file(folder, run.variant, evaluation), [f"seed={run.seed}"])

    # A log has no width of its own.
    console = Console(file=sys.stdout, width=100)
    result = train(recipe_of(MAIN), run.folder, console=console, device=device, resume=True)
    # It has saved, and the next call goes on from there.
    if result.stopped_by:
        return
    for name in evaluations:
        if not run.evaluated(name):
            evaluation = evaluate(result.model, recipe_of(name), result.steps)
            evaluation.write(run.evaluation(name))
            console.print(f"{name or 'evaluation'}: {evaluation.statement}", highlight=False)
