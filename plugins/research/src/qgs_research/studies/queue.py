"""The queue: as many runs at a time as there are workers, each in a process of its own."""

import json
import os
import signal
import time
from collections.abc import Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing import active_children, get_context
from pathlib import Path
from types import FrameType

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from qgs.files import write_text
from qgs.train.guard import CollapseError
from qgs.wording import listed
from qgs_research.studies.runs import Plan, Run
from qgs_research.studies.work import Outcome, begin, is_free, work

_POLL_SECONDS = 0.3
_TAIL = 4096
"""Bytes of a history that hold its last record."""
DEATHS = 3
"""Killed processes of a run in a row, without a save between, after which the run has failed."""

_PATIENCE = 120.0
"""Seconds that stopped runs have to save."""


@dataclass
class Queue:
    """Trains the missing ones of `runs`; see `work`.

    threads: of each run. gpus: shared by the workers. failures: runs that failed in this call.
    """

    plan: Plan
    runs: Sequence[Run]
    workers: int
    threads: int
    device: str
    console: Console
    gpus: Sequence[str] = ()
    failures: list[Run] = field(default_factory=list)
    _futures: dict[Run, Future[Outcome]] = field(default_factory=dict)
    _gpu_of: dict[Run, str] = field(default_factory=dict)
    _deaths: dict[Run, tuple[float, int]] = field(default_factory=dict)
    _stopping: str | None = None

    def work(self) -> str | None:
        """Run until nothing is missing; return the signal that ended it, if any.

        Waits for runs that another queue of this machine has, and continues them if it dies. A run
        that fails is reported, and not tried again by this call.
        """
        for run in self.runs:
            if run in self.plan.ended:
                # A collapsed training does not continue from its last save.
                and_folder = f" and {run.folder}" * run.failed.startswith(CollapseError.__name__)
                why = f"{run} is not trained again, it would end so each time: {run.failed}"
                self._say(f"{why}; to train it again, delete {run.failure}{and_folder}")
        before = {s: signal.signal(s, self._stop) for s in (signal.SIGINT, signal.SIGTERM)}
        bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TimeRemainingColumn(),
            console=self.console,
            disable=not self.console.is_terminal,
            # Runs take minutes to days: the time that is left comes from the last ten minutes.
            speed_estimate_period=600,
        )
        task = bar.add_task("", total=len(self.runs))
        try:
            with bar:
                while self._step():
                    shares = {run: self._share(run) for run in self.runs}
                    here = listed(f"{run} {shares[run]:.0%}" for run in self._futures)
                    bar.update(task, completed=sum(shares.values()), description=here)
                    time.sleep(_POLL_SECONDS)
        finally:
            self._end_processes()
            for number, handler in before.items():
                signal.signal(number, handler)
        return self._stopping

    def _stop(self, number: int, frame: FrameType | None) -> None:
        self._stopping = signal.Signals(number).name

    def _end_processes(self) -> None:
        """Let the processes save, and kill those that take too long."""
        for process in active_children():
            process.terminate()
        end = time.monotonic() + _PATIENCE
        for process in active_children():
            # All together have _PATIENCE, not each of them.
            process.join(max(end - time.monotonic(), 0.1))
            process.kill()

    def _step(self) -> bool:
        """Collect what has ended, start what is missing; True while there is work to wait for."""
        if self._stopping:
            return False
        for run, future in [*self._futures.items()]:
            if future.done():
                del self._futures[run]
                del self._gpu_of[run]
                self._collect(run, future)
        # One try a call: what failed would most likely fail again at once.
        over = {*self.failures, *self.plan.ended}
        missing = [run for run in self.runs if run not in over and not self.plan.done(run)]
        # Those that failed before come last: they may fail again.
        for run in sorted(missing, key=lambda run: run.failure.is_file()):
            if len(self._futures) == self.workers:
                break
            # Asked here, since a process that finds the run taken has imported torch for nothing.
            if run not in self._futures and is_free(run):
                # The GPU with the fewest runs.
                used = [*self._gpu_of.values()]
                self._gpu_of[run] = min(self.gpus, key=used.count, default="")
                self._futures[run] = self._start(run)
        return bool(missing)

    def _start(self, run: Run) -> Future[Outcome]:
        """Train `run` in a process of a pool of its own.

        A pool for each run: a process that is killed breaks its pool, and takes no other run along.
        """
        run.log.parent.mkdir(parents=True, exist_ok=True)
        pool = ProcessPoolExecutor(
            max_workers=1,
            mp_context=get_context("spawn"),
            initializer=begin,
            initargs=(run.log.absolute(), self.threads, self._gpu_of[run], os.getpid()),
        )
        folder = self.plan.folder.absolute()
        settings = (self.plan.evaluations, self.device, self.threads)
        future = pool.submit(work, folder, run.variant, run.seed, *settings)
        # The process ends after this run.
        pool.shutdown(wait=False)
        return future

    def _collect(self, run: Run, future: Future[Outcome]) -> None:
        """Report how a run ended; one whose process was killed may go on."""
        outcome = None if future.exception() else future.result()
        if outcome is Outcome.TAKEN:
            return
        if outcome is Outcome.DONE:
            done = [run for run in self.runs if self.plan.done(run)]
            self._say(f"{run} is done, {len(done)} of {len(self.runs)} runs")
            return
        if outcome is not Outcome.FAILED:
            if self._count_death(run) < DEATHS:
                self._say(f"{run}: its process was ended; it continues from its last save")
                return
            # The killed process could not write it.
            why = f"its process was ended {DEATHS} times without a save between"
            write_text(run.failure, f"{why}; memory may be short\n")
        self.failures.append(run)
        self._say(f"{run} failed: {run.failed} (see {run.log})")

    def _count_death(self, run: Run) -> int:
        """Return how often the process of `run` was ended in a row without a save between."""
        state = run.folder / "state.safetensors"
        # A run that saves between two kills gets on, however often it is killed.
        saved = state.stat().st_mtime if state.is_file() else 0.0
        before, count = self._deaths.get(run, (saved, 0))
        count = count + 1 if saved == before else 1
        self._deaths[run] = (saved, count)
        return count

    def _say(self, text: str) -> None:
        self.console.print(text, highlight=False, soft_wrap=True, markup=False)

    def _share(self, run: Run) -> float:
        """How much of a run's training is done, from 0 to 1."""
        step, seconds = last_record(run.folder / "history.jsonl")
        training = self.plan.recipes[run.variant].training
        # A run ends with its steps or its seconds, whichever comes first.
        of_seconds = seconds / training.seconds if training.seconds else 0.0
        return min(max(step / training.steps, of_seconds), 1.0)


def last_record(history: Path) -> tuple[int, float]:
    """Return step and seconds of the last whole record of a history; zeros without one."""
    if not history.is_file():
        return 0, 0.0
    with history.open("rb") as file:
        # The end alone: histories of long trainings have megabytes, and this is asked all the time.
        file.seek(max(history.stat().st_size - _TAIL, 0))
        lines = file.read().decode(errors="replace").split("\n")[:-1]
    for line in reversed(lines):
        # A killed process leaves a damaged line.
        with suppress(ValueError, TypeError, KeyError, RecursionError):
            record = json.loads(line)
            return int(record["step"]), float(record["seconds"])
    return 0, 0.0
