"""The queue: as many runs at a time as there are workers, each in a process of its own."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import timedelta
from pathlib import Path
from types import FrameType

from rich.console import Console

from qgs.files import write_text
from qgs.train.guard import CollapseError
from qgs.wording import listed
from qgs_research.studies.plan import Plan, Run
from qgs_research.studies.work import FAILED, TAKEN, is_free

_POLL_SECONDS = 0.3
_TAIL = 4096  # bytes of a history that hold its last record
DEATHS = 3
"""Killed processes of a run in a row, without a save between, after which the run has failed."""

_PATIENCE = 120.0  # seconds that stopped runs have to save


@dataclass
class Queue:
    """Trains the missing ones of `runs`, all of the plan by default; see `work`.

    threads: of each run. gpus: one for each worker in turn.
    failures: runs that failed in this call, and why.
    """

    plan: Plan
    workers: int
    threads: int
    device: str
    console: Console
    gpus: Sequence[str] = ()
    runs: Sequence[Run] = ()
    failures: dict[Run, str] = field(default_factory=dict)
    _processes: dict[Run, tuple[subprocess.Popen[bytes], int]] = field(default_factory=dict)
    _deaths: dict[Run, tuple[int, int]] = field(default_factory=dict)
    _stopping: str | None = None

    def __post_init__(self) -> None:
        self.runs = self.runs or self.plan.runs

    def work(self) -> str | None:
        """Run until nothing is missing; the signal that ended it, if any.

        Waits for runs that another queue of this machine has, and continues them if it dies. A run
        that fails is reported, and not tried again by this call.
        """
        before = {s: signal.signal(s, self._stop) for s in (signal.SIGINT, signal.SIGTERM)}
        for run in self.runs:
            if run.ended and not self.plan.done(run):
                why = f"{run} is not trained again, it would end so each time: {run.failed}"
                self._say(f"{why}; to train it again, delete {run.failure}{_and_folder(run)}")
        done = set(filter(self.plan.done, self.runs))
        try:
            with self.console.status(self._left()) as status:
                waiting = True
                while waiting:
                    waiting = self._step()
                    for run in self.runs:
                        if run not in done and self.plan.done(run):
                            done.add(run)
                            self._say(f"{run} is done, {self._left()}")
                    if self.console.is_terminal:
                        status.update(self._left())
                    time.sleep(_POLL_SECONDS)
        finally:
            for process, _ in self._processes.values():
                process.terminate()
            end = time.monotonic() + _PATIENCE
            for process, _ in self._processes.values():
                try:
                    process.wait(max(end - time.monotonic(), 0.1))
                except subprocess.TimeoutExpired:
                    process.kill()
            for number, handler in before.items():
                signal.signal(number, handler)
        return self._stopping

    def _step(self) -> bool:
        """Collect what has ended, start what is missing; True while there is work to wait for."""
        for run, (process, _) in [*self._processes.items()]:
            code = process.poll()
            if code is None:
                continue
            del self._processes[run]
            ended = code in (0, TAKEN)
            if not ended and not self._stopping and not self._goes_on(run, code):
                self._fail(run, code)
        if self._stopping:
            return False
        over = {*self.failures, *self.plan.ended}
        missing = [run for run in self.runs if run not in over and not self.plan.done(run)]
        for run in sorted(missing, key=lambda run: run.failure.is_file()):  # failed ones last
            if len(self._processes) >= self.workers:
                break
            if run not in self._processes and is_free(run):
                self._start(run)
        return bool(missing)

    def _start(self, run: Run) -> None:
        used = {slot for _, slot in self._processes.values()}
        slot = next(n for n in range(self.workers) if n not in used)
        threads = str(self.threads)
        counts = ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "MKL_NUM_THREADS")
        environment = {**os.environ, **dict.fromkeys(counts, threads)}
        if self.gpus:
            environment["CUDA_VISIBLE_DEVICES"] = self.gpus[slot % len(self.gpus)]
        where = [str(self.plan.folder), run.variant, str(run.seed)]
        options = ["--threads", threads, "--device", self.device, "--parent", str(os.getpid())]
        options += ["--evaluations", *self.plan.study.evaluations]
        run.log.parent.mkdir(parents=True, exist_ok=True)
        with run.log.open("ab") as log:
            process = subprocess.Popen(
                [sys.executable, "-m", "qgs_research.studies.work", *where, *options],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env=environment,
                process_group=0,  # a Ctrl-C reaches the queue alone, which stops its runs once
            )
        self._processes[run] = process, slot

    def _goes_on(self, run: Run, code: int) -> bool:
        """True to continue a run whose process was killed, unless DEATHS in a row saved nothing."""
        if not _signal(code):
            return False
        state = run.folder / "state.safetensors"
        saved = state.stat().st_mtime_ns if state.is_file() else 0
        before, times = self._deaths.get(run, (saved, 0))
        self._deaths[run] = saved, (times + 1 if saved == before else 1)
        if self._deaths[run][1] >= DEATHS:
            return False
        self._say(f"{run}: its process {_end(code)}; it continues from its last save")
        return True

    def _fail(self, run: Run, code: int) -> None:
        why = f"its process {_end(code)}"
        if code == FAILED and run.failure.is_file():
            why = run.failed
        elif _signal(code):
            why += f" {DEATHS} times without a save between; memory may be short"
            write_text(run.failure, f"{why}\n")  # the killed process could not
        self.failures[run] = why
        self._say(f"{run} failed: {why} (see {run.log})")

    def _stop(self, number: int, frame: FrameType | None) -> None:
        self._stopping = signal.Signals(number).name

    def _say(self, text: str) -> None:
        self.console.print(text, highlight=False, soft_wrap=True, markup=False)

    def _left(self) -> str:
        """Number of runs that are done, how far those here are, and about how long all take."""
        missing = [run for run in self.runs if not self.plan.done(run)]
        text = f"{len(self.runs) - len(missing)} of {len(self.runs)} runs"
        used, seconds = dict[Run, float](), dict[Run, float]()
        for run in self.runs:
            step, seconds[run] = last_record(run.folder / "history.jsonl")
            training = self.plan.recipes[run.variant].training
            of_seconds = seconds[run] / training.seconds if training.seconds else 0.0
            used[run] = min(max(step / training.steps, of_seconds), 1.0)
        here = listed(f"{run} {used[run]:.0%}" for run in self._processes)
        text += f", {here}" * bool(here)
        measured = [run for run in self.runs if used[run] > 0.02 and seconds[run]]
        open_ = [run for run in missing if run not in {*self.failures, *self.plan.ended}]
        if not measured or not open_:
            return text
        whole = sum(seconds[run] for run in measured) / sum(used[run] for run in measured)
        at_once = min(max(len(self._processes), 1), len(open_))
        left = whole * sum(1 - used[run] for run in open_) / at_once
        return f"{text}, about {timedelta(seconds=round(left))} left"


def _and_folder(run: Run) -> str:
    """What else to delete: a collapsed training does not continue from its last save."""
    return f" and {run.folder}" * run.failed.startswith(CollapseError.__name__)


def _end(code: int) -> str:
    """How a process ended, by its exit code."""
    if number := _signal(code):
        return f"was ended by {signal.Signals(number).name}"
    return f"ended with exit code {code}"


def _signal(code: int) -> int:
    """The signal that ended a process; 0 for another end, such as the exit code 255."""
    number = -code if code < 0 else code - 128
    return number if number in set(signal.Signals) else 0


def last_record(history: Path) -> tuple[int, float]:
    """Step and seconds of the last whole record of a history; zeros without one."""
    if not history.is_file():
        return 0, 0.0
    with history.open("rb") as file:
        file.seek(max(history.stat().st_size - _TAIL, 0))
        lines = file.read().decode(errors="replace").split("\n")[:-1]
    for line in reversed(lines):
        with suppress(ValueError, TypeError, KeyError, RecursionError):  # a damaged line
            record: Mapping[str, float] = json.loads(line)
            return int(record["step"]), float(record["seconds"])
    return 0, 0.0
