"""The queue: as many runs at a time as there are workers, each in a process of its own."""

import os
import signal
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from multiprocessing import get_context
from multiprocessing.context import SpawnProcess
from types import FrameType
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from qgs.evaluate.results import print_lines
from qgs.files import write_text
from qgs.train.guard import CollapseError
from qgs.wording import listed
from qgs_research.studies.runs import Plan, Run
from qgs_research.studies.work import begin, is_free, work

_POLL_SECONDS = 0.3
_DAY_SECONDS = 86_400
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
    _processes: dict[Run, SpawnProcess] = field(default_factory=dict)
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
            MofNCompleteColumn(),
            BarColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.description}"),
            console=self.console,
            disable=not self.console.is_terminal,
            # Runs take minutes to days.
            speed_estimate_period=_DAY_SECONDS,
        )
        task = bar.add_task("", total=len(self.runs))
        try:
            with bar:
                while self._step():
                    here = listed(self._processes)
                    bar.update(task, completed=self._done, description=here)
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
        for process in self._processes.values():
            process.terminate()
        end = time.monotonic() + _PATIENCE
        for process in self._processes.values():
            # All together have _PATIENCE, not each of them.
            process.join(max(end - time.monotonic(), 0.1))
            process.kill()

    def _step(self) -> bool:
        """Collect what has ended, start what is missing; True while there is work to wait for."""
        if self._stopping:
            return False
        for run, process in [*self._processes.items()]:
            if process.exitcode is not None:
                del self._processes[run]
                del self._gpu_of[run]
                self._collect(run, process.exitcode)
        # One try a call: what failed would most likely fail again at once.
        over = {*self.failures, *self.plan.ended}
        missing = [run for run in self.runs if run not in over and not self.plan.done(run)]
        # Those that failed before come last: they may fail again.
        for run in sorted(missing, key=lambda run: run.failure.is_file()):
            if len(self._processes) == self.workers:
                break
            # Asked here, since a process that finds the run taken has imported torch for nothing.
            if run not in self._processes and is_free(run):
                # The GPU with the fewest runs.
                used = [*self._gpu_of.values()]
                self._gpu_of[run] = min(self.gpus, key=used.count, default="")
                self._processes[run] = self._start(run)
        return bool(missing)

    def _start(self, run: Run) -> SpawnProcess:
        """Train `run` in a process of its own."""
        run.log.parent.mkdir(parents=True, exist_ok=True)
        # What an earlier call reported is over.
        run.failure.unlink(missing_ok=True)
        machine = (run.log.absolute(), self.threads, self._gpu_of[run], os.getpid())
        folder = self.plan.folder.absolute()
        settings = (self.plan.evaluations, self.device, self.threads)
        # Plain values: a process that reads a Run imports torch before its threads are set.
        arguments = (work, machine, (folder, run.variant, run.seed, *settings))
        process = get_context("spawn").Process(target=_begin_and_work, args=arguments)
        process.start()
        return process

    def _collect(self, run: Run, exitcode: int) -> None:
        """Report how a run ended; one whose process was killed may go on."""
        if self.plan.done(run):
            self._say(f"{run} is done, {self._done} of {len(self.runs)} runs")
            return
        if not run.failed:
            # It was stopped, and has saved, or another process has the run.
            if exitcode == 0:
                return
            if self._count_death(run) < DEATHS:
                self._say(f"{run}: its process was ended; it continues from its last save")
                return
            # The killed process could not write it.
            why = f"its process was ended {DEATHS} times without a save between"
            write_text(run.failure, f"{why}; memory may be short\n")
        self.failures.append(run)
        self._say(f"{run} failed: {run.failed} (see {run.log})")

    @property
    def _done(self) -> int:
        """Number of runs that are done."""
        return sum(map(self.plan.done, self.runs))

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
        print_lines(self.console, [text])


def _begin_and_work(task: Callable[..., Any], machine: Sequence[Any], run: Sequence[Any]) -> None:
    """Do `task` of a run in this new process."""
    begin(*machine)
    task(*run)
