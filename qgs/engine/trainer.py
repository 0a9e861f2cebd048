"""The training loop."""

from __future__ import annotations

import logging
import math
from collections.abc import Generator, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path
from typing import Any, NoReturn

import torch
from rich.console import Console
from torch import Tensor

from qgs.composer import Recipe
from qgs.data.loader import Share, scenes_fingerprint, training_batches
from qgs.data.sampling import Batch
from qgs.engine.clock import Clock
from qgs.engine.collapse import (
    BROKEN_REMEDIES,
    COLLAPSE_REMEDIES,
    CollapseDetector,
    CollapseError,
    GoodWeights,
    Vitals,
    broken_tensors,
    not_finite,
)
from qgs.engine.device import choose_device
from qgs.engine.ema import MovingAverage
from qgs.engine.folder import RunFolder
from qgs.engine.gradients import Gradients
from qgs.engine.incidents import PATIENCE, Incidents
from qgs.engine.initial import initialise
from qgs.engine.interrupt import StopRequest, stop_requests
from qgs.engine.objective import Objective
from qgs.engine.periodic import PeriodicEvaluation
from qgs.engine.prepare import prepared
from qgs.engine.processes import make_accelerator, mean
from qgs.engine.progress import TrainingProgress
from qgs.engine.resume import refuse_other_conditions, saved_state
from qgs.engine.saver import Saver
from qgs.engine.schedule import OneCycle
from qgs.engine.seeds import RandomStates, set_seed
from qgs.engine.state import Moments, SavedState, Stateful
from qgs.engine.trackers import Trackers
from qgs.model import QueryGaussianModel

_log = logging.getLogger(__name__)


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
    as `choose_device` and `OneCycle`, `qgs.engine.resume.OtherRunError` for another recipe or data
    than the run's, what the data source raises, and CollapseError when the model died; the
    checkpoint then holds the last good weights.
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
        with TrainingProgress(terminal) as progress, stop_requests() as stop:
            return trainer.run(progress, stop)


class Trainer:
    """The state of one run: model, optimiser, data, clock, detector.

    Making one opens the data and draws the first batch, but touches no file of `run`; the folder is
    made after the first step, when nothing is missing any more. What must survive an interruption
    is in `parts`, each with `state` and `load_state`, and counted here: optimiser steps and samples
    drawn, over all processes.
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
            self._batches = chain([next(self._stream)], self._stream)
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
        self._conditions = {
            "step_size": self.config.batch_size * batches,
            "scenes": scenes_fingerprint(self.source),
        }
        self.step = 0
        self.samples = 0
        self.parts: dict[str, Stateful] = {
            "counters": self,
            "moments": Moments(objective, self.optimizer),
            "schedule": self.schedule,
            "clock": self.clock,
            "detector": self.detector,
            "incidents": self.incidents,
            "random": RandomStates(self.accelerator),
        }
        if self.average:
            self.parts["ema"] = self.average
        self.saver = Saver(self.accelerator, self.folder, self.model, self.good, self.parts)

    def _restore(self, saved: SavedState) -> int:
        """Continue from `saved`; the step at which that is."""
        self.saver.restore(saved)
        return self.step

    def _open_stream(self) -> Generator[Batch, None, None]:
        """Batches from the first one that no optimiser step has seen."""
        processes = self.accelerator.num_processes
        return training_batches(
            self.source,
            self.recipe.views,
            self.config.batch_size,
            self.recipe.seed,
            start=self.samples // (self.config.batch_size * processes),
            share=Share(self.accelerator.process_index, processes),
            workers=self.config.workers,
        )

    def close(self) -> None:
        """Stop reading ahead, close the history and leave the folder to others."""
        self._resources.close()

    def state(self) -> dict[str, Any]:
        """See `qgs.engine.state.Stateful`."""
        return {"step": self.step, "samples": self.samples, **self._conditions}

    def load_state(self, state: Mapping[str, Any]) -> None:
        """See `qgs.engine.state.Stateful`. Raises OtherRunError."""
        refuse_other_conditions(state, self._conditions, self.folder)
        self.step, self.samples = state["step"], state["samples"]

    def run(self, progress: TrainingProgress, stop: StopRequest) -> TrainingResult:
        """Train until the budget is used, a stop is asked for, or the model dies."""
        if self.used >= 1:
            if not self.folder.checkpoint.exists():
                self._save()
            return self._result(None)
        while self.used < 1:
            record = self._optimise(stop)
            self._open_folder()
            self._report(record, progress)
            if self.detector.collapsed:
                symptom = f"for {self.detector.dead_steps} steps {self.detector.symptom}"
                self._give_up(symptom, COLLAPSE_REMEDIES)
            self._keep_good_weights()
            if self.config.evaluate_every and self.step % self.config.evaluate_every == 0:
                self._evaluate()
            if record["stop"]:
                break
        stopped_by = self._stopped_by(stop)
        self._finish(stopped_by)
        return self._result(stopped_by)

    def _result(self, stopped_by: str | None) -> TrainingResult:
        return TrainingResult(
            self.saver.whole_model().eval(),
            self.folder,
            self.step,
            self.clock.seconds,
            stopped_by,
            self.accelerator.is_main_process,
            self.resumed_at,
        )

    @property
    def used(self) -> float:
        """Fraction of the budget that is used, the larger of steps and seconds."""
        of_steps = self.step / self.config.steps
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
        rate = self.schedule.rate(self.step, self.clock.seconds)
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        self.optimizer.zero_grad(set_to_none=True)
        batches = list(islice(self._batches, self.config.accumulate))
        measured = self.gradients.compute(batches)
        scenes = sum(len(batch.scenes) for batch in batches)
        record = self._read(measured, stop)
        symptom = self._nonfinite(record)
        if symptom:
            self._leave_out(batches, symptom)
        else:
            self._apply(record)
        self.step += 1
        self.samples += scenes * self.accelerator.num_processes
        self.clock.tick()
        return {"step": self.step, "seconds": self.clock.seconds, "lr": rate, **record}

    def _apply(self, record: Mapping[str, float]) -> None:
        """Let the optimiser use the gradients of a step that `record` tells of."""
        self.optimizer.step()
        if self.average:
            self.average.update()
        self.incidents.passed()
        self.detector.observe(Vitals(record["alpha"], record["deviation"], record["gradient"]))

    def _leave_out(self, batches: Sequence[Batch], symptom: str) -> None:
        """Save a step that is not finite; end, or go on without it, as the recipe says."""
        self._open_folder()
        found = self.incidents.look_into(self.step + 1, batches, symptom)
        if self.config.on_nonfinite == "skip" and self.incidents.in_a_row <= PATIENCE:
            _log.warning("step %d is skipped: %s", self.step + 1, found)
            return
        if self.incidents.in_a_row > PATIENCE:
            found = f"{PATIENCE} steps in a row were skipped; {found}"
        if self.detector.dead_steps or broken_tensors(self.model):
            self._give_up(found, BROKEN_REMEDIES)
        self._save()
        self._fail(found, self.step, BROKEN_REMEDIES)

    def _evaluate(self) -> None:
        with self.clock.stopped():
            self.evaluations.run(self.step)

    def _report(self, record: dict[str, float], progress: TrainingProgress) -> None:
        if self.accelerator.is_main_process:
            told = {name: value for name, value in record.items() if math.isfinite(value)}
            self.folder.append(told)
            self.trackers.log(told, self.step)
        images, seconds = self.samples * self.recipe.views.targets, self.clock.seconds
        if progress.update(self.step, record["loss"], record["psnr"], images, seconds, self.used):
            self.folder.flush()

    def _read(self, measured: dict[str, Tensor], stop: StopRequest) -> dict[str, float]:
        """Numbers of one step, the mean over processes; the only synchronisation of a step."""
        asked = torch.tensor(float(bool(stop)), device=self.device)
        values = torch.stack([v.float() for v in (*measured.values(), asked)])
        numbers = mean(self.accelerator, values).tolist()
        return dict(zip([*measured, "stop"], numbers, strict=True))

    def _nonfinite(self, record: dict[str, float]) -> str:
        """What of a step is NaN or infinite; "" if nothing is."""
        terms = {k: v for k, v in record.items() if k not in ("gradient", "stop", "psnr")}
        return not_finite(terms, self.model, record["gradient"])

    def _keep_good_weights(self) -> None:
        if self.detector.dead_steps:
            return
        if self.step % self.config.collapse_window == 0:
            self._refuse_broken_weights()
            self.good.refresh(self.step)
        if self.config.save_every and self.step % self.config.save_every == 0:
            self._save()

    def _refuse_broken_weights(self) -> None:
        problem = broken_tensors(self.model)
        if problem:
            self._give_up(problem, BROKEN_REMEDIES)

    def _stopped_by(self, stop: StopRequest) -> str | None:
        """The signal's name when any process was asked to stop."""
        asked = mean(self.accelerator, torch.tensor(float(bool(stop)), device=self.device))
        name = stop.signal.name if stop.signal else "SIGTERM"
        return name if float(asked) else None

    def _finish(self, stopped_by: str | None) -> None:
        dead = self.detector.dead_steps
        symptom = f"for the last {dead} steps {self.detector.symptom}"
        if self.detector.dead_after(self.step) and not stopped_by:
            self._give_up(symptom, COLLAPSE_REMEDIES)
        if self.detector.dead_after(self.step):
            self.saver.save_good()
            self.saver.save_state()
            return
        if dead:
            _log.warning("training ended in doubt: %s; the weights are saved as they are", symptom)
        self._save()
        if self.average and not stopped_by and self.evaluations.latest != self.step:
            self._evaluate()

    def _give_up(self, problem: str, causes: Sequence[str]) -> NoReturn:
        self._open_folder()
        self.saver.save_good()
        self._fail(problem, self.good.step, causes)

    def _fail(self, problem: str, kept: int, causes: Sequence[str]) -> NoReturn:
        remedies = "".join(f"\n  - {cause}" for cause in causes)
        raise CollapseError(
            f"training collapsed at step {self.step}: {problem}. The weights of step "
            f"{kept} are kept in {self.folder.checkpoint}. Likely causes:{remedies}"
        )

    def _save(self) -> None:
        self._refuse_broken_weights()
        self.saver.save(self.step)
