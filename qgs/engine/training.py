"""The training loop."""

import logging
import math
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, closing, nullcontext
from dataclasses import dataclass, field
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import torch
from accelerate import Accelerator
from accelerate.utils import gather_object, set_seed
from rich.console import Console
from torch import Tensor, nn

from qgs.composer import Recipe
from qgs.composer.flow import keys_are_read
from qgs.composer.recipe import annotated
from qgs.contracts import Outcome, TrainingConfig
from qgs.data.sampling import Batch
from qgs.data.stream import Feed, SampleError, Share, scenes_fingerprint, training_batches
from qgs.engine.checkpoint import (
    OptimizerState,
    RandomStates,
    Saver,
    number_in,
    refuse_other_data,
    saved_state,
)
from qgs.engine.distributed import (
    StopRequest,
    average_gradients,
    choose_device,
    make_accelerator,
    mean,
    shard,
    stop_requests,
    unsynchronised,
    wants_shards,
    whole,
)
from qgs.engine.fit import explained, refuse_unfit
from qgs.engine.folder import FolderGoneError, RunFolder
from qgs.engine.guard import Guard, not_finite
from qgs.engine.initial import initialise
from qgs.engine.objective import TrainingPass
from qgs.engine.parameters import MovingAverage, make_optimizer
from qgs.engine.periodic import PeriodicEvaluation
from qgs.engine.tracking import Trackers, TrainingProgress
from qgs.io.files import write_text
from qgs.model import QueryGaussianModel

MAX_REASONS = 100
"""Reasons of samples left out that a process counts on their own; further ones are OTHERS."""

OTHERS = "for other reasons"

ELSEWHERE = "another process of this training has no next batch; its own message tells why"

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class TrainingResult:
    """What a run left: the trained model, its folder, optimiser steps, seconds on the clock.

    stopped_by: name of the signal that ended it early, else None. main: whether this process writes
    the files. resumed_at: the step from which a run was continued, None for one that began here.
    left_out: samples that could not be made (`training.on_bad_sample`), of all processes and
    sessions: how often.
    """

    model: QueryGaussianModel
    folder: RunFolder
    steps: int
    seconds: float
    stopped_by: str | None
    main: bool
    resumed_at: int | None = None
    left_out: Mapping[str, int] = field(default_factory=dict)


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
    or SIGTERM, which finish the step and return. A start that fails leaves no folder. Of several
    processes the main one writes; all of them must see `run`.

    resume: continue the run in `run` as if it had never been interrupted, or start it where there
    is none yet. A run whose budget is used is left as it is.

    Raises FileExistsError when `run` holds anything (with `resume`, anything but a run), ValueError
    as `choose_device`, `Recipe.rate_factors`, `make_optimizer` and the optimiser, OtherRunError for
    another recipe or data than the run's, CollapseError when the model died (the checkpoint then
    holds the last good weights), NonFiniteError for a step that gave NaN, and what the data source
    raises; the run is then saved where it stood, and a note of the error says so.
    """
    if not resume:
        RunFolder(run).refuse_other(resume)
    terminal = console or Console(stderr=True)
    chosen = choose_device(device, terminal.print)
    set_seed(recipe.seed)
    with closing(Trainer(recipe, run, chosen, resume)) as trainer:
        if not trainer.accelerator.is_main_process:
            terminal = Console(quiet=True)
        for note in trainer.notes:
            terminal.print(note, highlight=False)
        with TrainingProgress(terminal) as progress, stop_requests(terminal.quiet) as stop:
            try:
                return trainer.run(progress, stop)
            except FolderGoneError as error:
                trainer.save_elsewhere(error)
                raise


class Trainer:
    """One run: its state, and the loop.

    Making one opens the data and draws the first batch, but touches no file of a new run; its
    folder is made after the first step, when nothing is missing any more.

    step, samples, seconds: optimiser steps, samples over all processes, and time spent so far, in
        all sessions. A session's clock starts after its first step, in which kernels compile.
    """

    def __init__(
        self, recipe: Recipe, run: str | Path, device: str = "cpu", resume: bool = False
    ) -> None:
        self.recipe, self.config = recipe, recipe.training
        self.folder, self.trackers = RunFolder(run), Trackers(recipe.training.trackers)
        self.step, self.samples, self.seconds = 0, 0, 0.0
        self.left_out = Counter[str]()
        self._last_tick: float | None = None
        self._resumes, self._folder_is_open = resume, False
        with ExitStack() as resources:
            resources.callback(self.folder.close)
            resources.callback(self.trackers.close)
            self._build(device, resources)
            self._resources = resources.pop_all()

    def _build(self, device: str, resources: ExitStack) -> None:
        """Everything that has a state, as it is saved where the run is continued; then the data."""
        recipe, config = self.recipe, self.config
        self.optimizer = recipe.build_optimizer()
        self.accelerator = make_accelerator(device, unread=not keys_are_read(recipe.parts))
        saved = None
        if self._resumes:  # a folder that holds a run is this one's from now on
            self.folder.refuse_other(resume=True)
            if self.accelerator.is_main_process and not self.folder.is_new:
                self.folder.take()
            self.accelerator.wait_for_everyone()
            saved = saved_state(self.folder, recipe)
        refuse_unfit(recipe, self.accelerator)
        self.model = recipe.build_model(self.accelerator.device, pretrained=not saved).train()
        warnings = [f"warning: {text}" for text in recipe.warnings]
        self.notes = warnings + ([] if saved else initialise(self.model, recipe))
        objective = TrainingPass.of(recipe, self.model).to(self.accelerator.device)
        if wants_shards(self.accelerator):  # before the optimiser, whose moments lie in shards too
            shard(self.model)
        factors = recipe.rate_factors(objective)
        prepared: Any = objective, make_optimizer(objective, self.optimizer, factors)
        if not wants_shards(self.accelerator):
            prepared = self.accelerator.prepare(*prepared)
        self.objective, self.torch_optimizer = prepared
        self.average = MovingAverage(self.model, config.ema) if config.ema else None
        self.saver = Saver(self.accelerator, self.folder, self.model)
        self._gradients = partial(compute_gradients, self.accelerator, self.objective, config)
        self.guard = Guard(self.accelerator, objective, self.saver, recipe, self._gradients)
        self.evaluations = PeriodicEvaluation(
            self.accelerator, recipe, self.model, self.average, self.folder.path, self.trackers
        )
        source, processes = recipe.build_data(), self.accelerator.num_processes
        self._conditions = {
            "step_size": config.batch_size * config.accumulate * processes,
            "scenes": scenes_fingerprint(source),
        }
        self.saver.parts |= {  # besides the weights
            "guard": self.guard,
            "good": self.guard.good,
            "counters": self,
            "moments": OptimizerState(objective, self.torch_optimizer),
            "schedule": self.optimizer,
            "random": RandomStates(self.accelerator),
            **({"ema": self.average} if self.average else {}),
        }
        if saved:
            self.saver.restore(saved)
        self.resumed_at = self.step if saved else None
        self._follow = objective.follow
        self._follow(self.step)
        batches = training_batches(
            source,
            recipe.views,
            config.batch_size,
            recipe.seed,
            start=self.samples // (config.batch_size * processes),
            share=Share(self.accelerator.process_index, processes),
            workers=config.workers,
            skips=config.on_bad_sample == "skip",
        )
        resources.callback(batches.close)
        self.feed = Feed(batches, config.accumulate)
        self.feed.fetch()
        flag = torch.tensor(float(bool(self.feed.error)))
        failed = mean(self.accelerator, flag.to(self.accelerator.device))
        if float(failed):
            with explained(self.step):
                raise self.feed.error or SampleError(ELSEWHERE)

    def run(self, progress: TrainingProgress, stop: StopRequest) -> TrainingResult:
        """Train until the budget is used, a stop is asked for, or the model dies."""
        if self.used >= 1:
            if not self.folder.checkpoint.exists():
                self.guard.save(self.step)
            return self._result(None)
        stopped_by, alone = None, self.accelerator.num_processes == 1
        while self.used < 1 and not stopped_by:
            # Gradients of this step's batches; those of the next step are fetched meanwhile.
            rate = self.optimizer.learning_rate(self.step, self.seconds)
            for group in self.torch_optimizer.param_groups:
                group["lr"] = rate * group["factor"]
            self.torch_optimizer.zero_grad(set_to_none=True)
            batches = self.feed.batches
            with explained(self.step, self.guard.save_to_go_on if alone else None):
                measured = self._gradients(batches)
            for bad in (bad for batch in batches for bad in batch.left_out):
                known = bad in self.left_out or len(self.left_out) < MAX_REASONS
                reason = bad if known else OTHERS
                if not self.left_out[reason]:
                    _log.warning("a sample is left out: %s", bad)
                self.left_out[reason] += 1
            if not stop and self.step + 1 < self.config.steps:
                self.feed.fetch()
            numbers, asked_to_stop, no_data = self._means(measured, stop)

            # The optimiser step, unless something is not finite.
            symptom = not_finite(numbers, self.model)
            if symptom:
                self._open_folder()
                self.guard.leave_out(self.step, batches, symptom)
            else:
                with explained(self.step):
                    self.torch_optimizer.step()
                if self.average:
                    self.average.update()
                self.guard.passed(numbers)
                self.saver.see(batches)
            self.step += 1
            self._follow(self.step)
            self.samples += sum(len(b.scenes) for b in batches) * self.accelerator.num_processes
            self._tick()

            # What is told, saved and evaluated.
            self._open_folder()
            record = {"step": self.step, "seconds": self.seconds, "lr": rate, **numbers}
            self._report(record | ({"skipped": True} if symptom else {}), progress)
            self.guard.refuse_collapse(self.step)
            evaluates = self._every(self.config.evaluate_every)
            self.guard.keep_good(self.step)
            saves = self._every(self.config.save_every) or evaluates
            if saves and not self.guard.detector.dead_steps:
                self.guard.save(self.step)
            if evaluates:
                self._evaluate(stop)
            if asked_to_stop or evaluates:
                stopped_by = self._stopped_by(stop)
            if no_data and self.used < 1 and not stopped_by:
                self.guard.save_to_go_on(self.step)
                error = self.feed.error or SampleError(ELSEWHERE)
                error.add_note(f"The run is saved at step {self.step}; continue with --resume")
                with explained(self.step, lambda step: None):  # it is saved
                    raise error
        stopped_by = stopped_by or self._stopped_by(stop)
        self.guard.finish(self.step, stopped=stopped_by is not None)
        if self.average and not stopped_by and self.evaluations.latest != self.step:
            self._evaluate(stop)
            stopped_by = self._stopped_by(stop)
        return self._result(stopped_by)

    def save_elsewhere(self, gone: FolderGoneError) -> None:
        """Save the run beside its lost folder, and note so on `gone`; needs one process alone."""
        if self.accelerator.num_processes > 1:
            return
        places = (Path(f"{self.folder.path}-saved-{n}") for n in count(1))
        place = next(path for path in places if not path.exists())
        self.folder.close()
        self.folder = self.saver.folder = RunFolder(place)
        self.folder.take()
        write_text(self.folder.recipe, annotated(self.recipe) + "\n")
        self.saver.save(self.step)
        self.folder.close()
        note = f"The run, without its history, is saved at step {self.step} in {place}; it goes on"
        gone.add_note(f"{note} there with --resume --out {place}")

    @property
    def used(self) -> float:
        """Fraction of the budget that is used, the larger of steps and seconds."""
        of_seconds = self.seconds / self.config.seconds if self.config.seconds else 0.0
        return max(self.step / self.config.steps, of_seconds)

    def state(self) -> dict[str, Any]:
        """What was counted so far, and what must not change for this to mean the same."""
        counted = {"step": self.step, "samples": self.samples, "seconds": self.seconds}
        return counted | self._conditions | {"left_out": self._all_left_out()}

    def _all_left_out(self) -> dict[str, int]:
        """Samples left out by all processes, which must all call this."""
        own = [self.left_out]
        counts = gather_object(own) if self.accelerator.num_processes > 1 else own
        return dict(sum(counts, Counter[str]()))

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Count on from `state`. Raises OtherRunError, see `refuse_other_data`."""
        refuse_other_data(state, self._conditions, self.folder)
        self.step, self.samples = number_in(state, "step"), number_in(state, "samples")
        self.seconds = float(number_in(state, "seconds", float))
        if self.step > self.samples:
            raise ValueError(f"{self.step} steps of {self.samples} samples")
        if self.accelerator.is_main_process:
            self.left_out = Counter({key: int(n) for key, n in state["left_out"].items()})

    def close(self) -> None:
        """Stop reading ahead, close the history and leave the folder to others."""
        self._resources.close()

    def _means(
        self, measured: Mapping[str, Tensor], stop: StopRequest
    ) -> tuple[dict[str, float], bool, bool]:
        """Means of a step's numbers over processes; whether any must stop, or has no next batch."""
        flags = torch.tensor([bool(stop), bool(self.feed.error)]).to(self.accelerator.device)
        values = torch.stack([value.float() for value in (*measured.values(), *flags)])
        *numbers, asked_to_stop, no_data = mean(self.accelerator, values).tolist()
        return dict(zip(measured, numbers, strict=True)), asked_to_stop > 0, no_data > 0

    def _open_folder(self) -> None:
        """Make the folder, once, write the recipe, and drop records of steps that were lost."""
        if self._folder_is_open:
            return
        self._folder_is_open = True
        if self.accelerator.is_main_process:
            if not self._resumes:
                self.folder.refuse_other(resume=False)
            self.folder.take()
            write_text(self.folder.recipe, annotated(self.recipe) + "\n")
            self.folder.cut_history(self.resumed_at or 0)
            self.trackers.open(self.folder.path, self.recipe, self.resumed_at or 0)
        self.accelerator.wait_for_everyone()

    def _report(self, record: Mapping[str, float], progress: TrainingProgress) -> None:
        if self.accelerator.is_main_process:
            finite = {name: value for name, value in record.items() if math.isfinite(value)}
            self.folder.append(finite)
            self.trackers.log(finite, self.step)
        judged = self.recipe.training.judge_inputs * self.recipe.views.inputs
        images = self.samples * (self.recipe.views.targets + judged)
        shown = record["loss"], record["psnr"], images, self.seconds, self.used
        if progress.update(self.step, *shown):
            self.folder.flush()

    def _every(self, steps: int) -> bool:
        """Whether this step is one of every `steps`; none is where that is 0."""
        return bool(steps) and self.step % steps == 0

    def _tick(self) -> None:
        """Bring `seconds` up to date: the mean over processes, so that all decide alike."""
        now = time.perf_counter()
        spent = torch.tensor(now - (self._last_tick or now), device=self.accelerator.device)
        self.seconds += float(mean(self.accelerator, spent))
        self._last_tick = now

    def _evaluate(self, stop: StopRequest) -> None:
        """Evaluate, which takes no time on the clock."""
        self._tick()
        self.evaluations.run(self.step, stop)
        self._last_tick = time.perf_counter()

    def _stopped_by(self, stop: StopRequest) -> str | None:
        """The signal's name when any process was asked to stop."""
        asked = mean(self.accelerator, torch.tensor(float(bool(stop))).to(self.accelerator.device))
        name = stop.signal.name if stop.signal else "SIGTERM"
        return name if float(asked) else None

    def _result(self, stopped_by: str | None) -> TrainingResult:
        return TrainingResult(
            self.saver.whole_model().eval(),
            self.folder,
            self.step,
            self.seconds,
            stopped_by,
            self.accelerator.is_main_process,
            self.resumed_at,
            self._all_left_out(),
        )


def compute_gradients(
    accelerator: Accelerator, objective: nn.Module, config: TrainingConfig, batches: Sequence[Batch]
) -> dict[str, Tensor]:
    """Leave the gradients of the mean loss of `batches`, clipped; what was measured, 0-d.

    objective: as accelerate wraps it. Only the last batch exchanges gradients between processes.
    "gradient" is the norm before clipping, over all processes; the rest is of this one.
    """
    device, sums = accelerator.device, dict[str, Tensor]()
    for number, batch in enumerate(batches, start=1):
        last = number == len(batches)
        with nullcontext() if last else unsynchronised(accelerator, objective):
            inputs, targets = batch.inputs.to(device), batch.targets.to(device)
            with torch.autocast(device.type, torch.bfloat16, enabled=config.precision == "bf16"):
                outcome: Outcome = objective(inputs, targets)
            accelerator.backward(outcome.total / len(batches))
        found = {"loss": outcome.total.detach(), **outcome.terms, **outcome.signs}
        for name, value in found.items():
            sums[name] = sums.get(name, 0) + value / len(batches)
    average_gradients(accelerator, objective)
    norm = accelerator.clip_grad_norm_(objective.parameters(), config.clip)
    sums["gradient"] = whole(torch.as_tensor(norm)).to(device)
    return sums
