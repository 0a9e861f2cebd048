"""Training of a model: the function `train` and its loop."""

import logging
import math
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from functools import partial
from itertools import chain, islice
from pathlib import Path
from typing import Any

import torch
from accelerate.utils import gather_object, set_seed
from rich.console import Console

from qgs.contracts import SceneSource
from qgs.contracts.schedule import follow
from qgs.data.samples import Batch
from qgs.data.stream import (
    SampleError,
    SampleStream,
    scenes_fingerprint,
    trained_domain,
    training_batches,
)
from qgs.evaluate.evaluation import Measures
from qgs.files import write_text
from qgs.model import QueryGaussianModel
from qgs.recipe import Recipe
from qgs.recipe.checks import keys_are_read
from qgs.recipe.recipe import annotated, flat
from qgs.train.distributed import StopRequest, choose_device, make_accelerator, stop_requests
from qgs.train.folder import RunFolder, Saver, States, saved_state
from qgs.train.guard import Guard, not_finite
from qgs.train.initial import initialise
from qgs.train.periodic import judge
from qgs.train.state import (
    Counters,
    MovingAverage,
    OptimizerState,
    RandomStates,
    make_optimizer,
)
from qgs.train.tracking import Trackers, TrainingProgress
from qgs.train.training_pass import TrainingPass, compute_gradients
from qgs.wording import one_line, warn_once

_log = logging.getLogger(__name__)

ELSEWHERE = "another process of this training cannot load its next batch; see its message"


@dataclass(frozen=True)
class TrainingResult:
    """Result of a run: trained model, folder, optimiser steps, and seconds spent training.

    stopped_by: name of the signal that ended the run early; None if it is complete. main: True in
    the process that writes the files. resumed_at: step from which the run was continued; None for
    a new run.
    """

    model: QueryGaussianModel
    folder: RunFolder
    steps: int
    seconds: float
    stopped_by: str | None
    main: bool
    resumed_at: int | None


def train(
    recipe: Recipe,
    run: str | Path,
    *,
    console: Console | None = None,
    device: str = "auto",
    resume: bool = False,
) -> TrainingResult:
    """Train the model of `recipe` on `device` and save everything in the folder `run`.

    Writes recipe.yaml, history.jsonl (one record per optimiser step), checkpoint.safetensors (the
    model) and state.safetensors (everything needed to continue). The run is saved on schedule, at
    the end, and after SIGINT or SIGTERM, which end training after the current step. A start that
    fails leaves no folder. Only the main process writes; all processes must have access to `run`.

    resume: continue the run in `run` as if it had never been interrupted, or start a run if there
    is none yet. A run whose budget is used up is left as it is.

    Raises:
    - FileExistsError if `run` is not empty; with `resume`, if it holds anything but a run.
    - ValueError from `choose_device`, `Recipe.rate_factors`, `make_optimizer` and the optimiser.
    - OtherRunError if `resume` continues a run of another recipe or other data.
    - CollapseError if the model no longer renders or learns; the last good weights are saved.
    - NonFiniteError for a step with NaN or infinity.
    - Errors of the data source. The run is saved first, and a note on the error says so.
    """
    RunFolder(run).refuse_other(resume)  # before the data is opened, which may take minutes
    terminal = console or Console(stderr=True)
    chosen = choose_device(device, terminal.print)
    # Before the model is built: its initial weights are part of the recipe.
    set_seed(recipe.seed)
    with closing(Trainer(recipe, run, chosen, resume)) as trainer:
        if not trainer.accelerator.is_main_process:
            terminal = Console(quiet=True)
        for note in trainer.notes:
            terminal.print(note, highlight=False)
        with TrainingProgress(terminal) as progress, stop_requests(terminal.quiet) as stop:
            return trainer.run(progress, stop)


class Trainer:
    """One training run: its model, data, optimiser and loop.

    The constructor opens the data and loads the first batch, but writes no file of a new run. The
    folder is created after the first step, so that a start that fails leaves no folder.
    """

    def __init__(
        self, recipe: Recipe, run: str | Path, device: str = "cpu", resume: bool = False
    ) -> None:
        self.recipe = recipe
        self.config = recipe.training
        self.folder = RunFolder(run)
        self.trackers = Trackers(recipe.training.trackers)
        self._resumes = resume
        with ExitStack() as resources:
            resources.callback(self.folder.close)
            resources.callback(self.trackers.close)
            self.optimizer = recipe.build_optimizer()
            self.accelerator = make_accelerator(device, unread=not keys_are_read(recipe.parts))
            # The order matters. The state is read before the model takes memory. The model draws
            # its random numbers before anything else does. The data comes last, because its first
            # batch depends on how many samples the restored run has seen.
            saved: States = {}
            if resume and not self.folder.is_new:
                if self.accelerator.is_main_process:
                    self.folder.take()
                self.accelerator.wait_for_everyone()
                saved = saved_state(self.folder, recipe)
            self._build_model(initial=not saved)
            source = recipe.build_data()
            samples = SampleStream(
                source,
                recipe.views,
                recipe.seed,
                skips=self.config.on_bad_sample == "skip",
                sampler=recipe.build_view_sampler(),
                per_step=self.config.batch_size,
                depths=self.training_pass.reads_depths,
                sizes=self.config.image_sizes,
            )
            self._build_watchers(source, samples)
            if saved:
                self.saver.restore(saved)
            self.resumed_at = self.counters.step if saved else None
            self._follow_schedules()
            processes = self.accelerator.num_processes
            self._stream = training_batches(
                samples,
                self.config.scenes_per_batch(processes),
                # From the first batch that the run has not used yet; a step that accumulates takes
                # several batches.
                start=self.counters.step * self.config.accumulate,
                rank=self.accelerator.process_index,
                processes=processes,
                workers=self.config.workers,
            )
            resources.callback(self._stream.close)
            self._no_batches: Exception | None = None
            self._fetch()
            # Stops loading batches, closes trackers and unlocks the folder.
            self.close = resources.pop_all().close

    def _build_model(self, initial: bool) -> None:
        """Build the model, its training pass, torch's optimiser and the moving average.

        Collects warnings in `notes`. initial: whether to load pretrained weights and those of
        `init_from`, for a run that is not continued.
        """
        recipe = self.recipe
        self.model = recipe.build_model(self.accelerator.device, pretrained=initial).train()
        self.notes = [f"warning: {text}" for text in recipe.warnings]
        if initial:
            self.notes += initialise(self.model, recipe)
        # Users who set only the steps often inherit a time budget without noticing.
        if self.config.seconds:
            self.notes.append(
                f"training stops after {self.config.seconds:g} s (training.seconds) or "
                f"{self.config.steps:,} steps (training.steps), whichever comes first"
            )
        self.training_pass = TrainingPass(recipe, self.model).to(self.accelerator.device)
        factors = recipe.rate_factors(self.training_pass)
        self.torch_optimizer = make_optimizer(self.training_pass, self.optimizer, factors)
        wrapped: Any = self.accelerator.prepare(self.training_pass)
        self._gradients = partial(compute_gradients, self.accelerator, wrapped, self.config)
        self.average = MovingAverage(self.model, self.config.ema) if self.config.ema else None

    def _build_watchers(self, source: SceneSource, samples: SampleStream) -> None:
        """Build the counters, the guard and the saver; check the metrics before training."""
        recipe = self.recipe
        # Only the main process writes checkpoints, which carry the range of the training views.
        if self.accelerator.is_main_process:
            self.model.trained_on = trained_domain(samples, self.config.steps)
        self.counters = Counters(self.config, scenes_fingerprint(source))
        self.saver = Saver(self.folder, self.model)
        self.guard = Guard(self.training_pass, self.saver, self.config, self._gradients)
        # A metric that is wrong must fail now, not after the training.
        Measures(recipe)
        # Everything besides the weights that is needed to continue the run.
        stateful = {
            "guard": self.guard,
            "good": self.guard.good,
            "counters": self.counters,
            "moments": OptimizerState(self.training_pass, self.torch_optimizer),
            "schedule": self.optimizer,
        }
        if self.average:
            stateful["ema"] = self.average
        # Last: restoring something may draw random numbers.
        stateful["random"] = RandomStates()
        self.saver.stateful = stateful

    def _fetch(self) -> None:
        """Load the batches of the next step, or store the error for `_refuse_missing_batches`.

        Loading takes place during the present step, while a GPU still computes. Before the next
        step, all processes stop if one of them failed to load.
        """
        try:
            self._batches = list(islice(self._stream, self.config.accumulate))
        # Raised when all processes know of it.
        except Exception as error:
            self._no_batches = error

    def _follow_schedules(self) -> None:
        scheduled = (*self.training_pass.modules(), self.training_pass.objective, self.optimizer)
        follow(scheduled, self.counters.step)

    def run(self, progress: TrainingProgress, stop: StopRequest) -> TrainingResult:
        """Train until the budget is used up, a stop is requested, or training collapses."""
        counters = self.counters
        stopped_by = None
        while counters.used < 1 and not stopped_by:
            self._refuse_missing_batches()
            self._one_step(progress, stop)
            # A signal may have reached one process alone.
            stopped_by = next((asked.name for asked in gather_object(stop)), None)
        # A kill may have come between the state and the checkpoint of the last step.
        if counters.step != self.resumed_at or not self.folder.checkpoint.exists():
            self.guard.save(counters.step, ends=not stopped_by)
        return TrainingResult(
            model=self.model.eval(),
            folder=self.folder,
            steps=counters.step,
            seconds=counters.seconds,
            stopped_by=stopped_by,
            main=self.accelerator.is_main_process,
            resumed_at=self.resumed_at,
        )

    def _one_step(self, progress: TrainingProgress, stop: StopRequest) -> None:
        """Run one optimiser step and record it; save and evaluate as the recipe asks."""
        counters = self.counters
        batches = self._batches
        numbers = self._compute(batches, stop)
        symptom = not_finite(numbers)
        if not symptom:
            with self.guard.memory_explained(counters.step):
                self.torch_optimizer.step()
            if self.average:
                self.average.update_parameters(self.model)
        # Only now, so that a start that fails in its first step leaves no folder.
        if counters.step == (self.resumed_at or 0):
            self._open_folder()
        if symptom:
            self.guard.refuse_nonfinite(counters.step, batches, symptom)
            numbers["skipped"] = True
        counters.step += 1
        for reason in chain.from_iterable(batch.left_out for batch in batches):
            warn_once(f"a training sample is left out: {reason}")
        self._follow_schedules()
        self._report(numbers, progress)
        if not symptom:
            self.guard.watch(counters.step, numbers)
        # Averages are always evaluated at the end, because their recipe was written for them.
        evaluates = counters.every(self.config.evaluate_every) or (
            self.average is not None and counters.used >= 1
        )
        saves = evaluates or counters.every(self.config.save_every)
        # A model that may be dying must not be saved as a good one.
        if saves and not self.guard.signs.dead:
            self.guard.save(counters.step)
        if evaluates:
            self._evaluate(stop)

    def _compute(self, batches: Sequence[Batch], stop: StopRequest) -> dict[str, float]:
        """Compute gradients of `batches`, fetch the next batches; return numbers such as "lr"."""
        step = self.counters.step
        rate = self.optimizer.learning_rate(step, self.counters.seconds)
        for group in self.torch_optimizer.param_groups:
            # Torch's own schedulers support neither a time budget nor factors of parts.
            group["lr"] = rate * group["factor"]
        self.torch_optimizer.zero_grad(set_to_none=True)
        with self.guard.memory_explained(step, saves=True):
            measured = self._gradients(batches)
        # Before the numbers are read, so that a GPU computes gradients at the same time.
        if not stop and step + 1 < self.config.steps:
            self._fetch()
        return {"lr": rate, **self.counters.read(measured)}

    def _open_folder(self) -> None:
        """Create the folder, write the recipe, and drop records of steps after the last save."""
        if self.accelerator.is_main_process:
            self.folder.refuse_other(self._resumes)
            self.folder.take()
            write_text(self.folder.recipe, annotated(self.recipe) + "\n")
            self.folder.cut_records(self.counters.step)
            self.trackers.open(self.folder.path, flat(self.recipe.tree), self.counters.step)
        self.accelerator.wait_for_everyone()

    def _report(self, numbers: Mapping[str, float], progress: TrainingProgress) -> None:
        counters = self.counters
        record = {"step": counters.step, "seconds": counters.seconds, **numbers}
        if self.accelerator.is_main_process:
            # JSON has no NaN: a skipped step leaves only its finite numbers.
            finite = {name: value for name, value in record.items() if math.isfinite(value)}
            self.folder.append(finite)
            self.trackers.tell(lambda tracker: tracker.log(finite, counters.step))
        progress.show(counters.step, record["loss"], record["psnr"], counters.used)

    def _evaluate(self, stop: StopRequest) -> None:
        """Evaluate the present weights; log a failure without stopping training."""
        started = time.perf_counter()
        step = self.counters.step
        used = [torch.cuda.current_device()] if torch.cuda.is_initialized() else []
        try:
            # An evaluation must not change what the training draws afterwards.
            with torch.random.fork_rng(used):
                if self.accelerator.is_main_process:
                    judge(
                        self.recipe,
                        self.model,
                        self.average,
                        step,
                        self.folder,
                        self.trackers,
                        stop,
                    )
        except Exception as error:  # the run is saved, and worth more than an evaluation
            _log.warning("the evaluation at step %d failed: %s", step, one_line(error))
        # The others wait here, see TIMEOUT in `distributed`.
        self.accelerator.wait_for_everyone()
        # An evaluation's time does not count, but the time between it and the last step does.
        self.counters.last_tick += time.perf_counter() - started

    def _refuse_missing_batches(self) -> None:
        """Save the run and raise in all processes if one failed to load its next batches."""
        own = self._no_batches
        if not any(gather_object([own is not None])):
            return
        error = own or SampleError(ELSEWHERE)
        step = self.counters.step
        if step > (self.resumed_at or 0):
            self.guard.save(step)
            error.add_note(f"The run is saved at step {step}; continue with --resume")
        raise error
