"""The queue: as many runs at a time as there are workers, each in a process of its own."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import timedelta
from pathlib import Path
from types import FrameType
from typing import Literal, TypeAlias

from rich.console import Console
from rich.live import Live
from rich.table import Table

from qgs.contracts import TrainingConfig
from qgs.engine.guard import CollapseError
from qgs.io.files import write_text
from qgs.wording import listed
from qgs_studies.claims import owner
from qgs_studies.plan import Plan, Run
from qgs_studies.work import FAILED, TAKEN

State: TypeAlias = Literal["done", "running", "elsewhere", "failed", "waiting"]

_POLL_SECONDS = 0.3
_SHOW_SECONDS = 2.0
_LOOK_SECONDS = 5.0  # between two looks at runs of others
_TAIL = 4096  # bytes of a history that hold its last record
DEATHS = 3
"""Processes of a run that may die one after the other before it counts as failed."""

_PATIENCE = 120.0  # seconds that stopped runs have to save


@dataclass
class Progress:
    """How far a run is. used: fraction of its budget. seconds: on its clock."""

    state: State
    used: float = 0.0
    seconds: float = 0.0
    step: int = 0


@dataclass
class Queue:
    """Trains what is missing of `plan`; see `work`.

    threads: of each run. most: runs that are started at most. gpus: one for each worker in turn.
    """

    plan: Plan
    workers: int
    threads: int
    device: str
    console: Console
    most: int | None = None
    gpus: Sequence[str] = ()
    _processes: dict[Run, tuple[subprocess.Popen[bytes], int]] = field(default_factory=dict)
    _failed: dict[Run, str] = field(default_factory=dict)
    _deaths: dict[Run, tuple[int, int]] = field(default_factory=dict)
    _started: int = 0
    _stopping: str | None = None
    _looked: float = 0.0
    _elsewhere: dict[Run, str] = field(default_factory=dict)

    def work(self) -> str | None:
        """Run until nothing is missing, or `most` runs were made; the signal that ended it, if any.

        Waits for runs that others have, and takes over those of the dead. A run that fails is told
        and not tried again by this call.
        """
        before = {s: signal.signal(s, self._stop) for s in (signal.SIGINT, signal.SIGTERM)}
        for run in self.plan.ended:
            self._say(_not_again(run))
        shown, told = 0.0, dict.fromkeys(filter(self.plan.done, self.plan.runs), True)
        live = Live(console=self.console, auto_refresh=False, transient=True)
        try:
            with live if self.console.is_terminal else _Nothing():
                while self._step():
                    if self.console.is_terminal and time.monotonic() - shown > _SHOW_SECONDS:
                        shown = time.monotonic()
                        live.update(self._table(), refresh=True)
                    self._tell_done(told)
                    time.sleep(_POLL_SECONDS)
                self._tell_done(told)
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

    @property
    def failures(self) -> Mapping[Run, str]:
        """Runs that failed in this call, and why."""
        return self._failed

    def _step(self) -> bool:
        """Collect what has ended, start what is free; whether there is something to wait for."""
        for run, (process, _) in [*self._processes.items()]:
            code = process.poll()
            if code is None:
                continue
            del self._processes[run]
            if code == TAKEN:
                self._started -= 1
            elif code and not self._stopping and not self._goes_on(run, code):
                self._fail(run, code)
        if self._stopping:
            return False
        over = {*self._failed, *self.plan.ended}
        missing = [r for r in self.plan.runs if r not in over and not self.plan.done(r)]
        free = [run for run in missing if run not in self._processes]
        free.sort(key=lambda run: run.failure.is_file())  # so that one cannot use up all tries
        if time.monotonic() - self._looked > _LOOK_SECONDS:
            self._looked = time.monotonic()
            self._elsewhere = {run: who for run in free if (who := owner(run))}
        for run in free:
            if len(self._processes) >= self.workers or self._started == self.most:
                break
            if run not in self._elsewhere:
                self._start(run)
        if self.most is not None:  # others are free to take what is left
            return bool(self._processes)
        return bool(missing)

    def _start(self, run: Run) -> None:
        used = {slot for _, slot in self._processes.values()}
        slot = next(n for n in range(self.workers) if n not in used)
        threads = str(self.threads)
        environment = {**os.environ, "OMP_NUM_THREADS": threads, "NUMBA_NUM_THREADS": threads}
        environment |= {"MKL_NUM_THREADS": threads}
        if self.gpus:
            environment["CUDA_VISIBLE_DEVICES"] = self.gpus[slot % len(self.gpus)]
        where = [str(self.plan.folder), run.variant, str(run.seed)]
        options = ["--threads", threads, "--device", self.device, "--parent", str(os.getpid())]
        judged = ["--evaluations", *self.plan.study.evaluations] * bool(self.plan.study.evaluations)
        command = [sys.executable, "-m", "qgs_studies.work", *where, *options, *judged]
        run.log.parent.mkdir(parents=True, exist_ok=True)
        with run.log.open("ab") as log:
            process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env=environment,
                process_group=0,  # Ctrl-C is for the queue, which tells its runs once
            )
        self._processes[run] = process, slot
        self._started += 1

    def _goes_on(self, run: Run, code: int) -> bool:
        """Whether a run whose process was ended from outside is to be taken up again, and say so.

        It is, unless DEATHS processes in a row died without a step that was saved.
        """
        if 0 <= code <= 128:
            return False
        state = run.folder / "state.safetensors"
        saved = state.stat().st_mtime_ns if state.is_file() else 0
        before, times = self._deaths.get(run, (saved, 0))
        self._deaths[run] = saved, (times + 1 if saved == before else 1)
        if self._deaths[run][1] >= DEATHS:
            return False
        self._say(f"{run}: its process {_end(code)}; it goes on from where it was saved")
        self._started -= 1
        return True

    def _fail(self, run: Run, code: int) -> None:
        why = f"its process {_end(code)}"
        if code == FAILED and run.failure.is_file():
            why = run.failed
        elif code < 0 or code > 128:
            why += f" {DEATHS} times without a save between; memory may be short"
            write_text(run.failure, f"{why}\n")  # which it could not do itself
        self._failed[run] = why
        self._say(f"{run} failed: {why} (see {run.log})")

    def _stop(self, number: int, frame: FrameType | None) -> None:
        self._stopping = signal.Signals(number).name

    def _tell_done(self, told: dict[Run, bool]) -> None:
        for run in self.plan.runs:
            if run not in told and self.plan.done(run):
                told[run] = True
                self._say(f"{run} is done, {self._left()}")

    def _say(self, text: str) -> None:
        self.console.print(text, highlight=False, soft_wrap=True, markup=False)

    def progress(self, run: Run) -> Progress:
        """Where `run` stands."""
        step, seconds = last_record(run.folder / "history.jsonl")
        training = self.plan.recipes[run.variant].training
        used = used_of(training, step, seconds)
        if self.plan.done(run):
            return Progress("done", 1.0, seconds, step)
        state: State = "running" if run in self._processes else "waiting"
        state = "elsewhere" if run in self._elsewhere else state
        over = run in self._failed or run.ended
        return Progress("failed" if over else state, used, seconds, step)

    def _left(self) -> str:
        """How many runs are done, and about how long the others take."""
        found = [self.progress(run) for run in self.plan.runs]
        done = sum(p.state == "done" for p in found)
        text = f"{done} of {len(found)} runs"
        measured = [p for p in found if p.used > 0.02 and p.seconds]
        active = max(sum(p.state in ("running", "elsewhere") for p in found), 1)
        open_ = [p for p in found if p.state not in ("done", "failed")]
        if not measured or not open_:
            return text
        whole = sum(p.seconds for p in measured) / sum(p.used for p in measured)
        seconds = whole * sum(1 - p.used for p in open_) / min(active, len(open_))
        return f"{text}, about {timedelta(seconds=round(seconds))} left"

    def _table(self) -> Table:
        seeds, variants = self.plan.study.settings.seeds, [*self.plan.recipes]
        table = Table(title=f"{self.plan.study.title}: {self._left()}", title_justify="left")
        table.add_column("variant")
        for seed in seeds:
            table.add_column(f"seed {seed}", justify="right")
        runs = {(run.variant, run.seed): run for run in self.plan.runs}
        for variant in variants:
            cells = [_cell(self.progress(runs[variant, seed])) for seed in seeds]
            table.add_row(variant, *cells)
        if self._elsewhere:
            table.caption = f"elsewhere: {listed(sorted(set(self._elsewhere.values())))}"
        return table


def _not_again(run: Run) -> str:
    """Why a run that ended badly is left as it is, and what would train it again."""
    told = f"{run} is not trained again, it would end so each time: {run.failed}"
    if run.failed.startswith(CollapseError.__name__):
        return f"{told}; to train it from the start, delete {run.failure} and {run.folder}"
    return f"{told}; when the cause is gone, delete {run.failure}: it goes on from its last save"


def _end(code: int) -> str:
    """How a process ended, by its exit code."""
    if code < 0 or code > 128:
        return f"was ended by {signal.Signals(-code if code < 0 else code - 128).name}"
    return f"ended with exit code {code}"


class _Nothing:
    def __enter__(self) -> None: ...

    def __exit__(self, *_: object) -> None: ...


def _cell(progress: Progress) -> str:
    if progress.state in ("running", "elsewhere"):
        return f"{progress.used:.0%}{'' if progress.state == 'running' else ' elsewhere'}"
    resumes = progress.state == "waiting" and progress.used
    return f"waiting at {progress.used:.0%}" if resumes else progress.state


def used_of(training: TrainingConfig, step: int, seconds: float) -> float:
    """Fraction of the budget that is used, as the trainer counts."""
    of_seconds = seconds / training.seconds if training.seconds else 0.0
    return min(max(step / training.steps, of_seconds), 1.0)


def last_record(history: Path) -> tuple[int, float]:
    """Step and seconds of the last whole record of a history; zeros where there is none."""
    if not history.is_file():
        return 0, 0.0
    with history.open("rb") as file:
        file.seek(max(history.stat().st_size - _TAIL, 0))
        lines = file.read().decode(errors="replace").split("\n")[:-1]
    for line in reversed(lines):
        try:
            record = json.loads(line)
            return int(record["step"]), float(record["seconds"])
        except (ValueError, TypeError, KeyError):
            continue
    return 0, 0.0
