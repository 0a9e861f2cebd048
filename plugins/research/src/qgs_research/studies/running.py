"""Train and evaluate the runs of a study, each in its own process, several at a time.

A killed process loses only the training steps since its last save.
"""

import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Sequence
from pathlib import Path
from subprocess import Popen

import torch
from filelock import FileLock, Timeout
from rich.console import Console

from qgs.evaluate.evaluation import evaluate
from qgs.files import write_text
from qgs.recipe import Recipe, resolve
from qgs.terminal import print_lines
from qgs.train.distributed import stop_requests
from qgs.train.training import train
from qgs.wording import counted
from qgs_research.studies.plan import Plan, Run, planned, recipe_file, run_of, write_plan
from qgs_research.studies.results import Results, study_summary, write_files
from qgs_research.studies.study import MAIN, read_study

WORK = (sys.executable, "-m", "qgs_research.studies.running")
"""Command that starts the process of a run; the arguments of `main` are appended."""

_SECONDS = 0.3
"""Seconds between two checks for finished processes."""


def run_study(
    file: str, out: Path, workers: int, threads: int | None, only: int | None, device: str
) -> int:
    """Do the work of `qgs study`, and return the exit code.

    only: number of the one run to train, from 0; None trains all runs.
    """
    console = Console()
    with console.status("composing and checking all variants"):
        plan = planned(read_study(file), out)
        write_plan(plan)
    for name in plan.study.variants:
        recipe = plan.recipes[name, MAIN]
        print_lines(console, [f"warning: {name}: {warning}" for warning in recipe.warnings])
    missing = sum(not plan.done(run) for run in plan.runs)
    variants = counted(len(plan.study.variants), "variant")
    size = f"{variants} x {counted(len(plan.study.settings.seeds), 'seed')}"
    print_lines(console, [f"{size}: {counted(len(plan.runs), 'run')}, {missing} missing"])
    failed: Sequence[Run] = ()
    stopped = None
    if workers:
        runs = plan.runs if only is None else [plan.runs[only]]
        failed, stopped = train_missing(plan, runs, workers, threads, device, console)
    results = Results(plan)
    if results.columns:
        table = write_files(results)
        study_summary(results).show(console)
        print_lines(console, [f"written to {table}"])
    if stopped:
        print_lines(console, [f"stopped by {stopped.name}; repeat the command to continue"])
        # as shells report a process that a signal ended
        return 128 + stopped
    return int(bool(failed))


def train_missing(
    plan: Plan,
    runs: Sequence[Run],
    workers: int,
    threads: int | None,
    device: str,
    console: Console,
) -> tuple[list[Run], signal.Signals | None]:
    """Train and evaluate those of `runs` that are not done.

    Returns the failed runs, and the signal that stopped training (None if it was not stopped). If
    another call on this machine trains a run, this call waits for the run, and continues the run if
    that call dies. workers: number of runs trained at a time, which share the GPUs. threads: CPU
    threads per run; None divides the threads among the workers.
    """
    threads = threads or max(torch.get_num_threads() // workers, 1)
    # Slurm, for example, sets this variable: the other GPUs belong to other jobs.
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    every = map(str, range(torch.cuda.device_count()))
    gpus = [*every] if visible is None else visible.split(",")
    failed = [run for run in runs if run.failed]
    for run in failed:
        again = f"to retry, delete {run.failure}; to start from step 0, delete {run.folder} too"
        print_lines(console, [f"{run} failed in an earlier call: {run.failed}; {again}"])
    processes: dict[Run, Popen[bytes]] = {}
    gpu_of: dict[Run, str] = {}
    left = list(runs)
    with stop_requests(quiet=True) as stop:
        while (left or processes) and not stop:
            for run, process in [*processes.items()]:
                if process.poll() is not None:
                    del processes[run]
                    # Otherwise it was stopped and has saved, or another process has it.
                    if plan.done(run) or run.failed or process.returncode:
                        print_lines(console, [_ended(plan, run, process.returncode)])
                    # One try per call: a failed run would probably fail again at once.
                    if run.failed or process.returncode:
                        failed.append(run)
            left = [run for run in runs if run not in failed and not plan.done(run)]
            for run in left:
                # Otherwise a process would import torch before it finds that its run is taken.
                if len(processes) < workers and run not in processes and is_free(run):
                    used = [gpu_of[other] for other in processes]
                    gpu_of[run] = min(gpus, key=used.count, default="")
                    processes[run] = started(plan, run, threads, device, gpu_of[run])
            time.sleep(_SECONDS)
        for process in processes.values():
            # all are stopped before the first is waited for, so that they save at the same time
            process.terminate()
        for process in processes.values():
            process.wait()
    return failed, next(iter(stop), None)


def started(plan: Plan, run: Run, threads: int, device: str, gpu: str) -> Popen[bytes]:
    """Start a process that trains and evaluates `run` and prints to the log file of the run.

    gpu: value of CUDA_VISIBLE_DEVICES; "" leaves the variable unchanged.
    """
    # Libraries read these variables at import. A log has no width of its own.
    names = ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "MKL_NUM_THREADS")
    environment = {**os.environ, **dict.fromkeys(names, str(threads)), "COLUMNS": "100"}
    if gpu:
        environment["CUDA_VISIBLE_DEVICES"] = gpu
    words = (str(plan.folder), run.variant, str(run.seed), device, *plan.evaluations)
    with run.log.open("ab") as log:
        return Popen([*WORK, *words], stdout=log, stderr=log, env=environment)


def _ended(plan: Plan, run: Run, code: int) -> str:
    if plan.done(run):
        return f"{run} is done; {sum(map(plan.done, plan.runs))} of {len(plan.runs)} runs are done"
    if run.failed:
        return f"{run} failed: {run.failed} (see {run.log})"
    return (
        f"{run}: its process ended with exit code {code} (see {run.log}); "
        "repeat the command to continue it"
    )


def lock_of(run: Run) -> FileLock:
    """Return the lock of a run. Entering the lock raises Timeout if another process holds it."""
    run.folder.parent.mkdir(parents=True, exist_ok=True)
    # The kernel releases the lock when a process dies, so a killed run is free at once.
    return FileLock(run.beside("lock"), blocking=False)


def is_free(run: Run) -> bool:
    """Return True if no process trains or evaluates `run` at this moment."""
    try:
        with lock_of(run):
            return True
    except Timeout:
        return False


def main(folder: str, variant: str, seed: str, device: str, *evaluations: str) -> None:
    """Train and evaluate one run of the study in `folder`. Existing results are kept.

    If another process trains the run, this call does nothing. An error is written to a file beside
    the run folder.
    """
    # a call that is killed cannot end its runs, so each run watches its call
    threading.Thread(target=_end_with, args=(os.getppid(),), daemon=True).start()
    run = run_of(Path(folder), variant, int(seed))
    try:
        with lock_of(run):
            _train_and_evaluate(Path(folder), run, device, evaluations)
    except Timeout:
        return
    except Exception as error:
        traceback.print_exc()
        write_text(run.failure, f"{type(error).__name__}: {error}\n")


def _end_with(parent: int) -> None:
    """Send SIGTERM to this process when the parent process, of id `parent`, has ended."""
    while os.getppid() == parent:
        time.sleep(1.0)
    os.kill(os.getpid(), signal.SIGTERM)


def _train_and_evaluate(folder: Path, run: Run, device: str, evaluations: Sequence[str]) -> None:
    """Train `run` to the end, then do its missing evaluations.

    Raises the errors of training and evaluation. A stopped training is saved but not evaluated.
    """

    def recipe_of(evaluation: str) -> Recipe:
        return resolve(recipe_file(folder, run.variant, evaluation), [f"seed={run.seed}"])

    console = Console()
    result = train(recipe_of(MAIN), run.folder, console=console, device=device, resume=True)
    # The training has saved, and the next call continues from there.
    if result.stopped_by:
        return
    for name in evaluations:
        if not run.evaluated(name):
            evaluation = evaluate(result.model, recipe_of(name), result.steps)
            evaluation.write(run.evaluation(name))
            console.print(name or "evaluation")
            evaluation.show(console)


if __name__ == "__main__":
    main(*sys.argv[1:])
