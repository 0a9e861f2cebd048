"""The training loop."""

import logging
import math
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager, nullcontext, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import torch
from accelerate import Accelerator
from accelerate.utils import set_seed
from rich.console import Console
from torch import Tensor, nn

from qgs.contracts import Outcome, SceneSource, TrainingConfig, ViewSampler
from qgs.contracts.schedule import follow
from qgs.data.samples import Batch
from qgs.data.stream import (
    Feed,
    SampleError,
    Share,
    scenes_fingerprint,
    trained_domain,
    training_batches,
)
from qgs.domain import Domain
from qgs.files import write_text
from qgs.machine import is_out_of_memory
from qgs.model import QueryGaussianModel
from qgs.recipe import Recipe
from qgs.recipe.flow import keys_are_read
from qgs.recipe.recipe import annotated
from qgs.train.distributed import (
    RandomStates,
    StopRequest,
    choose_device,
    gathered,
    make_accelerator,
    mean,
    stop_requests,
)
from qgs.train.folder import RunFolder, Saver, State, refuse_other_data, saved_state
from qgs.train.guard import Guard, OutOfMemoryError, not_finite
from qgs.train.initial import initialise
from qgs.train.parameters import MovingAverage, OptimizerState, make_optimizer
from qgs.train.periodic import PeriodicEvaluation
from qgs.train.precision import autocast
from qgs.train.tracking import Trackers, TrainingProgress
from qgs.train.training_pass import TrainingPass

ELSEWHERE = "another process of this training has no next batch; see its own message"

LESS_MEMORY = (
    "lower views.inputs, views.targets, training.batch_size, "
    "data.image_size, model.queries.count or model.head.gaussians_per_query"
)

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
            # The order matters: the state is read before memory is taken for the model, the model
            # draws its random numbers before anything else does, and the data comes last, since
            # its first batch depends on how many samples the restored run has seen.
            self.optimizer = recipe.build_optimizer()
            self.accelerator = make_accelerator(device, unread=not keys_are_read(recipe.parts))
            processes = self.accelerator.num_processes
            scenes = self.config.scenes_per_batch(processes)
            self._batch_samples = scenes * processes
            saved = self._claim_folder()
            self._build_model(initial=saved is None)
            source = recipe.build_data()
            self._conditions = {
                "step_size": self.config.batch_size,
                "scenes": scenes_fingerprint(source),
            }
            sampler = recipe.build_view_sampler()
            self._build_parts(self._domain(source, sampler))
            if saved is not None:
                self.saver.restore(saved)
            self.resumed_at = self.step if saved is not None else None
            self._follow_schedules()
            batches = training_batches(
                source,
                recipe.views,
                scenes,
                recipe.seed,
                start=self.samples // self._batch_samples,
                share=Share(self.accelerator.process_index, processes),
                workers=self.config.workers,
                skips=self.config.on_bad_sample == "skip",
                sampler=sampler,
                accumulate=self.config.accumulate,
                depths=self.training_pass.reads_depths,
            )
            resources.callback(batches.close)
            self.feed = Feed(batches, self.config.accumulate)
            self._fetch_first()
            self._resources = resources.pop_all()

    def _claim_folder(self) -> Mapping[str, State] | None:
        """Lock the folder of a run that is continued; its saved parts, None to start at step 0."""
        if not self._resumes:
            return None
        self.folder.refuse_other(resume=True)
        if self.accelerator.is_main_process and not self.folder.is_new:
            self.folder.take()
        self.accelerator.wait_for_everyone()
        saved = saved_state(self.folder, self.recipe)
        return saved.parts if saved else None

    def _build_model(self, initial: bool) -> None:
        """The model, what trains it, and torch's optimiser; initial: load `init_from`."""
        recipe, accelerator = self.recipe, self.accelerator
        self.model = recipe.build_model(accelerator.device, pretrained=initial).train()
        self.notes = [f"warning: {text}" for text in recipe.warnings]
        self.notes += initialise(self.model, recipe) if initial else []
        if self.config.seconds:  # often inherited by recipes and options that set only the steps
            self.notes.append(
                f"stops after {self.config.seconds:g} s (training.seconds) or "
                f"{self.config.steps:,} steps (training.steps), whichever comes first"
            )
        self.training_pass = TrainingPass.of(recipe, self.model).to(accelerator.device)
        factors = recipe.rate_factors(self.training_pass)
        optimizer = make_optimizer(self.training_pass, self.optimizer, factors)
        prepared: Any = accelerator.prepare(self.training_pass, optimizer)
        wrapped, self.torch_optimizer = prepared
        self._gradients = partial(compute_gradients, accelerator, wrapped, self.config)
        self.average = MovingAverage(self.model, self.config.ema) if self.config.ema else None

    def _domain(self, source: SceneSource, sampler: ViewSampler) -> Domain:
        """What checkpoints carry; only the main process writes them."""
        if not self.accelerator.is_main_process:
            return Domain()
        recipe, steps = self.recipe, self.config.steps
        return trained_domain(source, recipe.views, recipe.seed, sampler, steps)

    def _build_parts(self, domain: Domain) -> None:
        """What watches, saves and judges; `saver.parts` is everything that continues the run."""
        accelerator, training_pass = self.accelerator, self.training_pass
        self.saver = Saver(accelerator, self.folder, self.model, domain)
        self.guard = Guard(accelerator, training_pass, self.saver, self.config, self._gradients)
        self.evaluations = PeriodicEvaluation(
            accelerator, self.recipe, self.model, self.average, self.folder.path, self.trackers
        )
        self.saver.parts |= {
            "guard": self.guard,
            "good": self.guard.good,
            "counters": self,
            "moments": OptimizerState(training_pass, self.torch_optimizer),
            "schedule": self.optimizer,
            **({"ema": self.average} if self.average else {}),
            # Last: restoring a part may draw random numbers.
            "random": RandomStates(accelerator),
        }

    def _follow_schedules(self) -> None:
        self.training_pass.follow(self.step)
        follow([self.optimizer], self.step)

    def _fetch_first(self) -> None:
        """Fetch the first batch; where one process fails, all raise, and none waits for it."""
        self.feed.fetch()
        flag = torch.tensor(float(bool(self.feed.error)), device=self.accelerator.device)
        if float(mean(self.accelerator, flag)):
            raise self.feed.error or SampleError(ELSEWHERE)

    def run(self, progress: TrainingProgress, stop: StopRequest) -> TrainingResult:
        """Train until the budget is used, a stop is asked for, or the model dies."""
        if self.used >= 1:
            if not self.folder.checkpoint.exists():
                self.guard.save(self.step)
            return self._result(None)
        stopped_by = None
        while self.used < 1 and not stopped_by:
            stopped_by = self._one_step(progress, stop)
        stopped_by = stopped_by or self._stopped_by(stop)
        # Saved before the last evaluation, which may take long or fail.
        self.guard.finish(self.step, stopped=stopped_by is not None)
        if self.average and not stopped_by and self.evaluations.latest != self.step:
            self._evaluate(stop)
            stopped_by = self._stopped_by(stop)
        return self._result(stopped_by)

    def _one_step(self, progress: TrainingProgress, stop: StopRequest) -> str | None:
        """One optimiser step, and what is due after it; the signal that asked to stop, or None."""
        rate = self._set_learning_rate()
        batches = self.feed.batches
        with self._memory_explained(saves=True):
            measured = self._gradients(batches)
        # The next batches are fetched before the step's numbers are read, so that a GPU computes
        # gradients meanwhile, and processes learn of a failure together with the numbers.
        if not stop and self.step + 1 < self.config.steps:
            self.feed.fetch()
        numbers, asked_to_stop, no_data = self._read(measured, stop)
        symptom = not_finite(numbers, self.model)
        if symptom:
            self._open_folder()  # an incident is saved in it
            self.guard.leave_out(self.step, batches, symptom)
        else:
            self._update(numbers)
        self.step += 1
        self.samples += self._batch_samples * len(batches)
        self._follow_schedules()
        # Only now, so that a start that fails in its first step leaves no folder.
        self._open_folder()
        record = {"step": self.step, "seconds": self.seconds, "lr": rate, **numbers}
        self._report(record | ({"skipped": True} if symptom else {}), batches, progress)
        # A dead model must not be saved as a good one, so this comes before saving.
        self.guard.refuse_collapse(self.step)
        self.guard.keep_good(self.step)
        return self._save_and_evaluate(stop, asked_to_stop, no_data)

    def _set_learning_rate(self) -> float:
        rate = self.optimizer.learning_rate(self.step, self.seconds)
        for group in self.torch_optimizer.param_groups:
            # Torch's own schedulers know no time budget and no factors of parts.
            group["lr"] = rate * group["factor"]
        self.torch_optimizer.zero_grad(set_to_none=True)
        return rate

    def _update(self, numbers: Mapping[str, float]) -> None:
        with self._memory_explained():
            self.torch_optimizer.step()
        if self.average:
            self.average.update()
        self.guard.passed(numbers)

    def _save_and_evaluate(
        self, stop: StopRequest, asked_to_stop: bool, no_data: bool
    ) -> str | None:
        evaluates = self._every(self.config.evaluate_every)
        saves = evaluates or self._every(self.config.save_every)
        if saves and not self.guard.detector.dead_steps:
            self.guard.save(self.step)
        if evaluates:
            self._evaluate(stop)
        stopped_by = self._stopped_by(stop) if asked_to_stop or evaluates else None
        if no_data and self.used < 1 and not stopped_by:
            self.guard.save_to_go_on(self.step)
            error = self.feed.error or SampleError(ELSEWHERE)
            error.add_note(f"The run is saved at step {self.step}; continue with --resume")
            raise error
        return stopped_by

    @contextmanager
    def _memory_explained(self, saves: bool = False) -> Iterator[None]:
        """Raise OutOfMemoryError where the block finds no memory; saves: weights are untouched."""
        try:
            yield
        except Exception as error:
            if not is_out_of_memory(error):
                raise
            # Saving takes memory too; the files of the last save are whole in any case. With
            # several processes the others would wait for this one in vain.
            if saves and self.step and self.accelerator.num_processes == 1:
                with suppress(Exception):
                    self.guard.save_to_go_on(self.step)
            raise OutOfMemoryError(
                f"out of memory in step {self.step + 1}: {str(error).splitlines()[0][:300]}. "
                "What was saved continues with --resume and a higher training.accumulate, more "
                "processes, or fewer training.render_views. A new run also takes less when you "
                f"{LESS_MEMORY}."
            ) from error

    @property
    def used(self) -> float:
        """Fraction of the budget that is used, the larger of steps and seconds."""
        of_seconds = self.seconds / self.config.seconds if self.config.seconds else 0.0
        return max(self.step / self.config.steps, of_seconds)

    def state(self) -> dict[str, Any]:
        """Counters, and what must not change for them to mean the same."""
        counted = {"step": self.step, "samples": self.samples, "seconds": self.seconds}
        return counted | self._conditions | {"left_out": self._all_left_out()}

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Count on from `state`. Raises OtherRunError, see `refuse_other_data`."""
        refuse_other_data(state, self._conditions, self.folder)
        self.step, self.samples, self.seconds = (state[n] for n in ("step", "samples", "seconds"))
        if self.accelerator.is_main_process:  # of all processes: one counts on
            self.left_out = Counter(state["left_out"])

    def _all_left_out(self) -> dict[str, int]:
        """Samples left out by all processes, which must all call this."""
        return dict(sum(gathered(self.accelerator, self.left_out), Counter[str]()))

    def close(self) -> None:
        """Stop reading ahead, close the history and leave the folder to others."""
        self._resources.close()

    def _read(
        self, measured: Mapping[str, Tensor], stop: StopRequest
    ) -> tuple[dict[str, float], bool, bool]:
        """Means of a step's numbers over processes; whether any must stop, or has no next batch.

        The one time in a step that the host waits for the device, so the clock is read here too:
        its mean over processes, so that all use up a budget of time together.
        """
        now = time.perf_counter()
        spent, self._last_tick = now - (self._last_tick or now), now
        own = torch.tensor([spent, bool(stop), bool(self.feed.error)]).to(self.accelerator.device)
        values = torch.stack([value.float() for value in (*measured.values(), *own)])
        *numbers, spent, asked_to_stop, no_data = mean(self.accelerator, values).tolist()
        self.seconds += spent
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

    def _report(
        self, record: Mapping[str, float], batches: Sequence[Batch], progress: TrainingProgress
    ) -> None:
        for bad in (bad for batch in batches for bad in batch.left_out):
            if bad not in self.left_out:
                _log.warning("a sample is left out: %s", bad)
            self.left_out[bad] += 1
        if self.accelerator.is_main_process:
            # JSON has no NaN: a skipped step leaves only its finite numbers.
            finite = {name: value for name, value in record.items() if math.isfinite(value)}
            self.folder.append(finite)
            self.trackers.log(finite, self.step)
        judged = self.config.judge_inputs * self.recipe.views.inputs
        images = self.samples * (self.recipe.views.targets + judged)
        shown = record["loss"], record["psnr"], images, self.seconds, self.used
        if progress.update(self.step, *shown):
            self.folder.flush()

    def _every(self, steps: int) -> bool:
        """Whether this step is one of every `steps`; none is where that is 0."""
        return bool(steps) and self.step % steps == 0

    def _evaluate(self, stop: StopRequest) -> None:
        """Evaluate, with the clock stopped."""
        started = time.perf_counter()
        self.evaluations.run(self.step, stop)
        # Shifted, not reset: the time since the last step still counts.
        if self._last_tick is not None:
            self._last_tick += time.perf_counter() - started

    def _stopped_by(self, stop: StopRequest) -> str | None:
        """The signal's name when any process was asked to stop."""
        asked = mean(self.accelerator, torch.tensor(float(bool(stop))).to(self.accelerator.device))
        name = stop.signal.name if stop.signal else "SIGTERM"
        return name if float(asked) else None

    def _result(self, stopped_by: str | None) -> TrainingResult:
        return TrainingResult(
            self.model.eval(),
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

    objective: a `TrainingPass` as accelerate wraps it. "gradient" is the norm before clipping, over
    all processes; the rest is of this one. Nothing waits for the device.
    """
    device, sums = accelerator.device, dict[str, Tensor]()
    for number, batch in enumerate(batches, start=1):
        # Only the last batch exchanges gradients between processes.
        with nullcontext() if number == len(batches) else accelerator.no_sync(objective):
            inputs, targets = batch.inputs.to(device), batch.targets.to(device)
            with autocast(config.precision, device.type):
                outcome: Outcome = objective(inputs, targets)
            accelerator.backward(outcome.total / len(batches))
        found = {"loss": outcome.total.detach(), **outcome.terms, **outcome.signs}
        for name, value in found.items():
            sums[name] = sums.get(name, 0) + value / len(batches)
    # After the exchange, so that all processes clip by the same norm.
    norm = accelerator.clip_grad_norm_(objective.parameters(), config.clip)
    sums["gradient"] = torch.as_tensor(norm, device=device)
    return sums
