"""One run in a process of its own: lock it, train, evaluate; started by the queue.

A killed process takes nothing with it but its own run's last steps since they were saved.
"""

import argparse
import fcntl
import os
import signal
import sys
import threading
import time
import traceback
from pathlib import Path
from typing import IO

import torch
from rich.console import Console

from qgs.checkpoint.model_file import CheckpointFile
from qgs.evaluate.evaluation import evaluate
from qgs.files import write_text
from qgs.recipe import resolve
from qgs.train.training import train
from qgs_research.studies.plan import (
    Run,
    evaluation_file,
    judged_by,
    read_evaluation,
    recipe_file,
    run_of,
)

FAILED, TAKEN = 1, 3
"""Exit codes: the reason is in the log and beside the run; another process has the run."""

_WATCH_SECONDS = 1.0


def locked(run: Run) -> IO[str] | None:
    """An open file that holds `run` until it is closed; None if another process has the run.

    The kernel releases the lock of a process that dies, so a killed run is free at once.
    """
    lock = run.folder.with_name(f"{run.folder.name}.lock")
    lock.parent.mkdir(parents=True, exist_ok=True)
    file = lock.open("a")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        file.close()
        return None
    except OSError:
        pass  # this file system knows no locks
    return file


def is_free(run: Run) -> bool:
    """Whether no process has `run`."""
    file = locked(run)
    if file:
        file.close()
    return file is not None


def main() -> int:
    """What `python -m qgs_research.studies.work` does; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("variant")
    parser.add_argument("seed", type=int)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--parent", type=int, required=True)
    parser.add_argument("--evaluations", nargs="*", default=[])
    given = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    _end_with(given.parent)
    run = run_of(given.folder, given.variant, given.seed)
    lock = locked(run)
    if lock is None:
        return TAKEN
    try:
        torch.set_num_threads(given.threads)
        code = _work(given.folder, run, given.evaluations, given.device)
        run.failure.unlink(missing_ok=True)
        return code
    except Exception as error:
        traceback.print_exc()
        write_text(run.failure, f"{type(error).__name__}: {error}\n")
        return FAILED
    finally:
        lock.close()


def _work(folder: Path, run: Run, evaluations: list[str], device: str) -> int:
    """Train `run` as far as it was not, judge what was not; 0, or 128 + the signal that ended it.

    Raises whatever training and judging raise.
    """
    recipe = resolve(recipe_file(folder, run.variant), [f"seed={run.seed}"])
    console = Console(file=sys.stdout, width=100)
    result = train(recipe, run.folder, console=console, device=device, resume=True)
    if result.stopped_by:
        return 128 + signal.Signals[result.stopped_by]
    with CheckpointFile(result.folder.checkpoint) as file:
        seen = file.domain
    for name in ("", *evaluations):
        if run.judged(name):
            continue
        changes = read_evaluation(evaluation_file(folder, name)) if name else None
        judged = judged_by(recipe, changes) if changes else recipe
        evaluation = evaluate(result.model, judged, result.steps, trained_on=seen)
        evaluation.write(run.evaluation(name))
        console.print(f"{name or 'evaluation'}: {evaluation.statement}", highlight=False)
    return 0


def _end_with(parent: int) -> None:
    """Stop, as SIGTERM does, when the queue that started this process is gone."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_WATCH_SECONDS)
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=watch, daemon=True).start()


if __name__ == "__main__":
    sys.exit(main())
