"""The training loop."""

from __future__ import annotations

import math
import time
from collections.abc import Generator, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import torch
from accelerate import Accelerator
from rich.console import Console
from torch import Tensor, nn
from torch.optim import Optimizer

from qgs.composer import Recipe
from qgs.contracts import TrainingConfig
from qgs.data.sampling import Batch
from qgs.data.stream import Feed, SampleError, Share, scenes_fingerprint, training_batches
from qgs.engine.checkpoint import (
    Counters,
    Moments,
    RandomStates,
    SavedState,
    Stateful,
    initialise,
    saved_state,
    set_seed,
)
from qgs.engine.distributed import (
    StopRequest,
    choose_device,
    make_accelerator,
    mean,
    shard,
    stop_requests,
    wants_shards,
)
from qgs.engine.folder import RunFolder
from qgs.engine.guard import CollapseDetector, GoodWeights, Vitals, not_finite
from qgs.engine.nonfinite import Incidents
from qgs.engine.objective import Gradients, Objective
from qgs.engine.optimizer import MovingAverage, OneCycle, make_optimizer
from qgs.engine.periodic import PeriodicEvaluation
from qgs.engine.saving import Endings, Saver
from qgs.engine.tracking import Trackers, TrainingProgress
from qgs.model import QueryGaussianModel


class Clock:
    """Seconds of training, over all sessions of a run.

    A session's clock starts after its first step, in which kernels compile.
    """

    def __init__(self, accelerator: Accelerator) -> None:
        self.seconds = 0.0
        self._accelerator = accelerator
        self._before = 0.0
        self._started: float | None = None

    def tick(self) -> None:
        """Bring `seconds` up to date: the mean over processes, so that all decide alike."""
        now = time.perf_counter()
        if self._started is None:
            self._started = now
        elapsed = torch.tensor(now - self._started, device=self._accelerator.device)
        self.seconds = self._before + float(mean(self._accelerator, elapsed))

    @contextmanager
    def stopped(self) -> Iterator[None]:
        """Leave the time of the `with` block out."""
        since = time.perf_counter()
        yield
        if self._started is not None:
            self._started += time.perf_counter() - since

    def state(self) -> dict[str, Any]:
        """See `qgs.engine.checkpoint.Stateful`."""
        return {"seconds": self.seconds}

    def load_state(self, state: Mapping[str, Any]) -> None:
        """See `qgs.engine.checkpoint.Stateful`."""
        self.seconds = self._before = state["seconds"]


def prepared(
    accelerator: Accelerator, objective: Objective, config: TrainingConfig
) -> tuple[nn.Module, Optimizer]:
    """`objective`, wrapped where processes must exchange gradients, and its optimiser.

    Under `accelerate launch --use_fsdp` the model's parameters are laid in shards, in place and
    before the optimiser is made, so that its moments lie in shards too; else several processes run
    DistributedDataParallel.
    """
    if wants_shards(accelerator):
        shard(objective.model)
        return objective, make_optimizer(objective, config)
    return accelerator.prepare(objective, make_optimizer(objective, config))


_FLAGS = ("stop", "failed")
"""Of a step's record: whether a process was asked to stop, and whether one has no next batch."""


@dataclass(frozen=True)
class TrainingResult:
    """What a run left: the trained model, its folder, optimiser steps, seconds on the clock.

    stopped_by: name of the signal that ended it early, else None; SIGTERM where another process got
    the signal. main: whether this is the one process, of several, that writes files. resumed_at:
    the step from which a run was continued, None for one that began here.
    """

    model: QueryGaussianModel
    folder: RunFolder
    steps: int
    seconds: float
    stopped_by: str | None
    main: bool
    resumed_at: int | None = None


def train(
    recipe: Recipe,
    run: str | Path,
    *,
    console: Console | None = None,
    device: str = "auto",
    resume: bool = False,
) -> TrainingResult:
    """Train the model of `recipe` on `device` and leave everything in the folder `run`.

    Writes recipe.yaml, history.jsonl (one record per optimiser step), checkpoint.safetensors (the
    model) and state.safetensors (what continues the run): on schedule, at the end, and after SIGINT
    or SIGTERM, which finish the step and return. The clock of `training.seconds` starts after the
    first step, in which kernels compile. A start that fails, for want of data for instance, leaves
    no folder. Of several processes the main one writes; all of them must see `run`.

    resume: continue the run in `run` from its state, as if it had never been interrupted, or start
    it where there is none yet. A run whose budget is used is left as it is.

    Raises FileExistsError when `run` holds anything (with `resume`, anything but a run), ValueError
    as `choose_device` and `OneCycle`, `OtherRunError` for another recipe or data
    than the run's, what the data source raises, CollapseError when the model died, the checkpoint
    then holding the last good weights, and NonFiniteError for a step that gave NaN. An error of the
    data, between two steps, leaves the run saved where it stood; a note of the error says so.
    """
    if not resume:
        RunFolder(run).refuse_used()
    terminal = console or Console(stderr=True)
    chosen = choose_device(device, terminal.print)
    set_seed(recipe.seed)
    with closing(Trainer(recipe, run, chosen, resume)) as trainer:
        if not trainer.accelerator.is_main_process:
            terminal = Console(quiet=True)
        for note in trainer.notes:
            terminal.print(note, highlight=False)
        with TrainingProgress(terminal) as progress, stop_requests(terminal.quiet) as stop:
            return trainer.run(progress, stop)


class Trainer:
    """The state of one run: model, optimiser, data, clock, detector.

    Making one opens the data and draws the first batch, but touches no file of `run`; the folder is
    made after the first step, when nothing is missing any more. What must survive an interruption
    is in parts that the saver knows, each with `state` and `load_state`.
    """

    def __init__(
        self, recipe: Recipe, run: str | Path, device: str = "cpu", resume: bool = False
    ) -> None:
        self.recipe = recipe
        self.config = recipe.training
        self._resumes = resume
        self.folder = RunFolder(run)
        self.trackers = Trackers(self.config.trackers)
        self.schedule = OneCycle(self.config)
        self.accelerator = make_accelerator(device)
        self.device = self.accelerator.device
        with ExitStack() as resources:
            resources.callback(self.folder.close)
            resources.callback(self.trackers.close)
            saved = self._claim_folder() if resume else None
            self._build(fresh=saved is None)
            self.resumed_at = self._restore(saved) if saved else None
            self._stream = self._open_stream()
            resources.callback(self._stream.close)
            self.feed = Feed(self._stream, self.config.accumulate)
            self.feed.fetch()
            if self.feed.error:
                raise self.feed.error
            self._resources = resources.pop_all()
        self._folder_is_open = False

    def _claim_folder(self) -> SavedState | None:
        """The state to continue from; a folder that holds a run is this one's from now on."""
        self.folder.refuse_foreign()
        if self.accelerator.is_main_process and not self.folder.is_new:
            self.folder.take()
        self.accelerator.wait_for_everyone()
        return saved_state(self.folder, self.recipe)

    def _build(self, fresh: bool) -> None:
        """Everything with a state, as it is before the first step."""
        self.model = self.recipe.build_model(device=self.device).train()
        self.notes = initialise(self.model, self.recipe) if fresh else []
        losses = self.recipe.build_losses()
        objective = Objective(self.model, losses, self.config.render_views).to(self.device)
        self.objective, self.optimizer = prepared(self.accelerator, objective, self.config)
        self.gradients = Gradients(self.accelerator, self.objective, self.config)
        self.detector = CollapseDetector(self.config.collapse_window)
        self.good = GoodWeights(self.model, keep=self.accelerator.is_main_process)
        self.clock = Clock(self.accelerator)
        decay, run = self.config.ema, self.folder.path
        self.average = MovingAverage(self.model, decay) if decay else None
        self.incidents = Incidents(self.accelerator, objective, self.gradients, run)
        self.evaluations = PeriodicEvaluation(
            self.accelerator, self.recipe, self.model, self.average, run, self.trackers
        )
        self.source = self.recipe.build_data()
        batches = self.config.accumulate * self.accelerator.num_processes
        conditions = {
            "step_size": self.config.batch_size * batches,
            "scenes": scenes_fingerprint(self.source),
        }
        self.counters = Counters(conditions, self.folder)
        parts: dict[str, Stateful] = {
            "counters": self.counters,
            "moments": Moments(objective, self.optimizer),
            "schedule": self.schedule,
            "clock": self.clock,
            "detector": self.detector,
            "incidents": self.incidents,
            "random": RandomStates(self.accelerator),
        }
        if self.average:
            parts["ema"] = self.average
        self.saver = Saver(self.accelerator, self.folder, self.model, self.good, parts)
        skips = self.config.on_nonfinite == "skip"
        self.endings = Endings(self.saver, self.counters, self.detector, self.incidents, skips)

    def _restore(self, saved: SavedState) -> int:
        """Continue from `saved`; the step at which that is."""
        self.saver.restore(saved)
        return self.counters.step

    def _open_stream(self) -> Generator[Batch, None, None]:
        """Batches from the first one that no optimiser step has seen."""
        processes = self.accelerator.num_processes
        return training_batches(
            self.source,
            self.recipe.views,
            self.config.batch_size,
            self.recipe.seed,
            start=self.counters.samples // (self.config.batch_size * processes),
            share=Share(self.accelerator.process_index, processes),
            workers=self.config.workers,
        )

    def close(self) -> None:
        """Stop reading ahead, close the history and leave the folder to others."""
        self._resources.close()

    def run(self, progress: TrainingProgress, stop: StopRequest) -> TrainingResult:
        """Train until the budget is used, a stop is asked for, or the model dies."""
        if self.used >= 1:
            if not self.folder.checkpoint.exists():
                self.endings.save()
            return self._result(None)
        stopped_by = None
        while self.used < 1 and not stopped_by:
            record = self._optimise(stop)
            self._open_folder()
            self._report(record, progress)
            self.endings.refuse_collapse()
            self._keep_good_weights()
            if self._every(self.config.evaluate_every):
                self._evaluate(stop)
            if record["stop"] or self._every(self.config.evaluate_every):
                stopped_by = self._stopped_by(stop)
            if record["failed"] and self.used < 1 and not stopped_by:
                self._end_without_data()
        stopped_by = stopped_by or self._stopped_by(stop)
        self.endings.finish(stopped_by)
        if self.average and not stopped_by and self.evaluations.latest != self.counters.step:
            self._evaluate(stop)
            stopped_by = self._stopped_by(stop)
        return self._result(stopped_by)

    def _result(self, stopped_by: str | None) -> TrainingResult:
        return TrainingResult(
            self.saver.whole_model().eval(),
            self.folder,
            self.counters.step,
            self.clock.seconds,
            stopped_by,
            self.accelerator.is_main_process,
            self.resumed_at,
        )

    @property
    def used(self) -> float:
        """Fraction of the budget that is used, the larger of steps and seconds."""
        of_steps = self.counters.step / self.config.steps
        budget = self.config.seconds
        of_seconds = self.clock.seconds / budget if budget else 0.0
        return max(of_steps, of_seconds)

    def _open_folder(self) -> None:
        """Make the folder, once, write the recipe, and drop records of steps that were lost.

        Raises FileExistsError.
        """
        if self._folder_is_open:
            return
        self._folder_is_open = True
        if self.accelerator.is_main_process:
            if not self._resumes:
                self.folder.refuse_used()
            self.folder.take()
            self.folder.write_recipe(self.recipe)
            self.folder.cut_history(self.resumed_at or 0)
            self.trackers.open(self.folder.path, self.recipe, self.resumed_at or 0)
        self.accelerator.wait_for_everyone()

    def _optimise(self, stop: StopRequest) -> dict[str, float]:
        """One optimiser step; returns its record for the history."""
        rate = self.schedule.rate(self.counters.step, self.clock.seconds)
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        self.optimizer.zero_grad(set_to_none=True)
        batches = self.feed.batches
        measured = self.gradients.compute(batches)
        if not stop and self.counters.step + 1 < self.config.steps:
            self.feed.fetch()
        scenes = sum(len(batch.scenes) for batch in batches)
        record = self._read(measured, stop)
        symptom = self._nonfinite(record)
        if symptom:
            self._open_folder()
            self.endings.leave_out(batches, symptom)
            record["skipped"] = True
        else:
            self._apply(record)
        self.counters.step += 1
        self.counters.samples += scenes * self.accelerator.num_processes
        self.clock.tick()
        return {"step": self.counters.step, "seconds": self.clock.seconds, "lr": rate, **record}

    def _apply(self, record: Mapping[str, float]) -> None:
        """Let the optimiser use the gradients of a step that `record` tells of."""
        self.optimizer.step()
        if self.average:
            self.average.update()
        self.incidents.passed()
        self.detector.observe(Vitals(record["alpha"], record["deviation"], record["gradient"]))

    def _end_without_data(self) -> NoReturn:
        """Save the run and raise what kept this process, or another one, from its next batch."""
        self.endings.keep()
        error = self.feed.error or SampleError(
            "another process of this training has no next batch; its own message tells why"
        )
        error.add_note(f"The run is saved at step {self.counters.step}; continue with --resume")
        raise error

    def _evaluate(self, stop: StopRequest) -> None:
        with self.clock.stopped():
            self.evaluations.run(self.counters.step, stop)

    def _every(self, steps: int) -> bool:
        """Whether this step is one of every `steps`; none is where that is 0."""
        return bool(steps) and self.counters.step % steps == 0

    def _report(self, record: dict[str, float], progress: TrainingProgress) -> None:
        if self.accelerator.is_main_process:
            numbers = {name: value for name, value in record.items() if name not in _FLAGS}
            told = {name: value for name, value in numbers.items() if math.isfinite(value)}
            self.folder.append(told)
            self.trackers.log(told, self.counters.step)
        images, seconds = self.counters.samples * self.recipe.views.targets, self.clock.seconds
        shown = record["loss"], record["psnr"], images, seconds, self.used
        if progress.update(self.counters.step, *shown):
            self.folder.flush()

    def _read(self, measured: dict[str, Tensor], stop: StopRequest) -> dict[str, float]:
        """Numbers of one step, the mean over processes; the only synchronisation of a step."""
        flags = torch.tensor([bool(stop), bool(self.feed.error)], device=self.device).float()
        values = torch.stack([v.float() for v in (*measured.values(), *flags)])
        numbers = mean(self.accelerator, values).tolist()
        return dict(zip([*measured, *_FLAGS], numbers, strict=True))

    def _nonfinite(self, record: dict[str, float]) -> str:
        """What of a step is NaN or infinite; "" if nothing is."""
        terms = {k: v for k, v in record.items() if k not in ("gradient", "psnr", *_FLAGS)}
        return not_finite(terms, self.model, record["gradient"])

    def _keep_good_weights(self) -> None:
        if self.detector.dead_steps:
            return
        if self._every(self.config.collapse_window):
            self.endings.refuse_broken_weights()
            self.good.refresh(self.counters.step)
        if self._every(self.config.save_every) or self._every(self.config.evaluate_every):
            self.endings.save()

    def _stopped_by(self, stop: StopRequest) -> str | None:
        """The signal's name when any process was asked to stop."""
        asked = mean(self.accelerator, torch.tensor(float(bool(stop)), device=self.device))
        name = stop.signal.name if stop.signal else "SIGTERM"
        return name if float(asked) else None
