"""What ends a run by itself: a model that died, and steps that are not finite."""

import logging
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NoReturn

from accelerate import Accelerator
from torch import Tensor, nn

from qgs.checkpoint.model_file import unique_tensors
from qgs.checkpoint.tensors import nonfinite
from qgs.contracts import TrainingConfig
from qgs.data.samples import Batch
from qgs.train.distributed import gathered
from qgs.train.folder import Saver
from qgs.train.incidents import Report, first_bad_tensor, save_batches, save_incident
from qgs.train.training_pass import TrainingPass
from qgs.wording import listed

_log = logging.getLogger(__name__)

EMPTY_ALPHA = 2e-3
"""Mean alpha below which a rendering shows the background alone."""

FLAT = 1 / 255
"""Mean deviation from the background of a rendering that shows nothing else."""

NO_GRADIENT = 1e-8
"""Gradient norm of a model that learns nothing any more."""

LOSS_OF_QUALITY = 1.0
"""dB below the best PSNR so far, means of some ten steps, at which weights are no longer good."""

MAX_SKIPPED = 10
"""Steps in a row that may be skipped; after them training stops."""

MAX_SAVED = 20
"""Incidents of a run that are saved; later ones are logged and counted."""

_TOO_FAST = (
    "a learning rate too high for this model (lower optimizer.learning_rate, lengthen "
    "optimizer.warmup)"
)

COLLAPSE_CAUSES = (
    _TOO_FAST,
    "a visibility loss too strong or absent (try losses.visibility.weight 0.1 with behind_camera: "
    "invisible)",
    "an initialisation that hides every Gaussian (raise model.head.opacity_bias)",
    "a scale of the world that leaves none before the cameras (check views.scale and "
    "views.scale_factor against the anchors' and the scenes' depth)",
)

NONFINITE_CAUSES = (
    _TOO_FAST,
    "a range that bfloat16 does not hold (training.precision: float32)",
    "data that is not finite: images, poses or intrinsics (look at the scenes of `data`; with "
    "views.scale distance, at input cameras that almost stand on one point)",
)


class TrainingError(RuntimeError):
    """Training stopped by itself; the message says why, what is kept and what to do."""


class CollapseError(TrainingError):
    """The model died; the last good weights are kept."""


class NonFiniteError(TrainingError):
    """A step gave NaN or infinity; the run is saved as it was before that step."""


class OutOfMemoryError(TrainingError):
    """A step found no memory; the message says what is kept and what takes less."""


class Guard:
    """Stops a run that is dead or not finite, and sees that good weights are kept.

    All processes must call each of its methods together; `step` counts finished optimiser steps.

    incidents: steps that were not finite. skipped: how many of them came last, without a good one.
    """

    def __init__(
        self,
        accelerator: Accelerator,
        objective: TrainingPass,
        saver: Saver,
        config: TrainingConfig,
        repeat: Callable[[Sequence[Batch]], Any],
    ) -> None:
        """objective: not wrapped by accelerate. repeat: computes the gradients of batches again."""
        self.detector = CollapseDetector(config.collapse_window)
        self.good = GoodWeights(objective.model, keep=accelerator.is_main_process)
        self.incidents = self.skipped = 0
        self._accelerator, self._objective, self._repeat = accelerator, objective, repeat
        self._saver, self._skips = saver, config.on_nonfinite == "skip"

    def state(self) -> dict[str, Any]:
        counts = {"incidents": self.incidents, "skipped": self.skipped}
        return {**counts, "detector": self.detector.state()}

    def load_state(self, state: Mapping[str, Any]) -> None:
        self.incidents, self.skipped = state["incidents"], state["skipped"]
        self.detector.load_state(state["detector"])

    def passed(self, numbers: Mapping[str, float]) -> None:
        """Take note of a finite step."""
        self.skipped = 0
        self.detector.observe(numbers)
        self.good.observe(numbers)

    def leave_out(self, step: int, batches: Sequence[Batch], symptom: str) -> None:
        """Look into the step after `step`, which is not finite; return to go on without it.

        Raises NonFiniteError, the run saved as before that step, or CollapseError.
        """
        found, from_data = self.look_into(step + 1, batches, symptom)
        if self._skips and self.skipped <= MAX_SKIPPED:
            _log.warning("step %d is skipped: %s", step + 1, found)
            return
        # A model that was dying gave this NaN: going on from here would not help.
        if self.detector.dead_steps or broken_tensors(self._saver.model):
            self._collapse(step + 1, found, NONFINITE_CAUSES)
        self._saver.save(step)
        if self.skipped > MAX_SKIPPED:
            remedy = f", after {MAX_SKIPPED} steps in a row were skipped; continue with --resume"
        else:
            remedy = "; continue without it by `--resume --set training.on_nonfinite=skip`"
        causes = f"Likely causes:{_as_list(NONFINITE_CAUSES)}"
        if from_data:
            causes = "The data is to blame: look at it with `qgs data check`"
        raise NonFiniteError(
            f"step {step + 1} is not finite, and the run is saved as it was before this "
            f"step{remedy}.\n{found}.\n{causes}"
        )

    def look_into(self, step: int, batches: Sequence[Batch], symptom: str) -> tuple[str, bool]:
        """Repeat a step to find its first bad tensor; save what it takes to see it again.

        Returns a description of what was found, and whether it came with the data of a batch.
        """
        self.incidents += 1
        self.skipped += 1
        accelerator, place = self._accelerator, self._saver.folder.path / "incidents"
        # All processes repeat the step: its collective operations need everyone.
        first = first_bad_tensor(self._objective, lambda: self._repeat(batches))
        reports = gathered(accelerator, Report.of(accelerator.process_index, first, batches))
        found = [report for report in reports if report.first] or reports[:1]
        words = f"{symptom}; {'; '.join(map(str, found))}; "
        if self.incidents > MAX_SAVED:
            words += f"not saved, as {MAX_SAVED} incidents of this run are"
        else:
            place = place / f"step-{step}"
            words += f"batch and weights are in {place}"
            if accelerator.is_main_process:
                save_incident(place, self._saver.model, step, symptom, reports)
                save_batches(place / "batch.safetensors", batches)
            elif first:
                save_batches(place / f"batch-{accelerator.process_index}.safetensors", batches)
            accelerator.wait_for_everyone()
        return words, all(report.blames_data for report in found)

    def refuse_collapse(self, step: int) -> None:
        """Raise CollapseError when the last steps, a whole window of them, were dead."""
        if self.detector.dead_steps >= self.detector.window:
            symptom = f"for {self.detector.dead_steps} steps {self.detector.symptom}"
            self._collapse(step, symptom, COLLAPSE_CAUSES)

    def keep_good(self, step: int) -> None:
        """Copy the weights if a copy is due and PSNR has not dropped.

        Raises CollapseError for weights that are not finite.
        """
        if not self.detector.dead_steps and self.good.due(step, self.detector.window):
            self._refuse_broken_weights(step)
            self.good.refresh(step)

    def save(self, step: int) -> None:
        """Save the run. Raises CollapseError for weights that are not finite."""
        self._refuse_broken_weights(step)
        self._saver.save(step)

    def save_to_go_on(self, step: int) -> None:
        """Save the run as one that may go on; a dead model's checkpoint is the last good one."""
        if self.detector.dead_after(step):
            self._saver.save_checkpoint(self.good.step, self.good.tensors)
            # The state keeps the dead weights: a resumed run must equal an uninterrupted one.
            self._saver.save(step, state_only=True)
        else:
            self.save(step)

    def finish(self, step: int, stopped: bool) -> None:
        """Save a run whose budget is used or that was stopped. Raises CollapseError."""
        symptom = f"for the last {self.detector.dead_steps} steps {self.detector.symptom}"
        if self.detector.dead_after(step):
            if not stopped:
                self._collapse(step, symptom, COLLAPSE_CAUSES)
        elif self.detector.dead_steps:
            _log.warning("training ended in doubt: %s; the weights are saved as they are", symptom)
        self.save_to_go_on(step)

    def _refuse_broken_weights(self, step: int) -> None:
        if problem := broken_tensors(self._saver.model):
            self._collapse(step, problem, NONFINITE_CAUSES)

    def _collapse(self, step: int, problem: str, causes: Sequence[str]) -> NoReturn:
        self._saver.save_checkpoint(self.good.step, self.good.tensors)
        raise CollapseError(
            f"training collapsed at step {step}: {problem}. The weights of step {self.good.step} "
            f"are kept in {self._saver.folder.checkpoint}. Likely causes:{_as_list(causes)}"
        )


def _as_list(causes: Iterable[str]) -> str:
    return "".join(f"\n  - {cause}" for cause in causes)


class CollapseDetector:
    """Counts consecutive steps without signs of life.

    A step is dead when nothing is drawn (mean alpha under EMPTY_ALPHA), when no gradient is left,
    or when the images have gone back to the plain background after showing more.
    """

    def __init__(self, window: int) -> None:
        self.window = window
        self.dead_steps = 0
        self.symptom = ""
        self._has_drawn = False

    def observe(self, numbers: Mapping[str, float]) -> None:
        """Take note of a step: "alpha" and "deviation" of its renderings, "gradient" (norm)."""
        self.symptom = ""
        if numbers["alpha"] < EMPTY_ALPHA:
            self.symptom = f"the renderings are empty (mean alpha {numbers['alpha']:.1e})"
        elif numbers["gradient"] < NO_GRADIENT:
            self.symptom = f"the gradient has vanished (norm {numbers['gradient']:.1e})"
        # At the start plain images are normal: queries have not found the scene yet.
        elif self._has_drawn and numbers["deviation"] < FLAT:
            self.symptom = "the renderings equal the background"
        self.dead_steps = self.dead_steps + 1 if self.symptom else 0
        # Well above FLAT, so that noise around the threshold is no image.
        self._has_drawn |= numbers["deviation"] > 8 * FLAT

    def dead_after(self, steps: int) -> bool:
        """Whether all of a run's `steps` so far, or the whole window, were dead."""
        return self.dead_steps >= min(self.window, steps)

    def state(self) -> dict[str, Any]:
        return {"dead": self.dead_steps, "symptom": self.symptom, "has_drawn": self._has_drawn}

    def load_state(self, state: Mapping[str, Any]) -> None:
        self.dead_steps, self.symptom = state["dead"], state["symptom"]
        self._has_drawn = state["has_drawn"]


class GoodWeights:
    """Copies in host memory of the weights at the last two times that the model was healthy.

    A collapse is noticed late, and the newer copy may already be on its way down; `tensors` after
    `step` optimiser steps are the older one. Copies are made every fifth of a window at first and a
    window in long runs, and none is made while the images are worse than they were.

    keep: whether this process holds the copies; one of several suffices.
    """

    def __init__(self, model: nn.Module, keep: bool = True) -> None:
        self._model, self._keep = model, keep
        self._copies: list[tuple[int, dict[str, Tensor]]] = []
        self._psnr: float | None = None
        self._best: float | None = None
        self.refresh(0)

    def observe(self, numbers: Mapping[str, float]) -> None:
        """Take note of a step's "psnr", in dB."""
        now = numbers["psnr"]
        # PSNR of one batch depends on its scenes: compare running means.
        self._psnr = now if self._psnr is None else self._psnr + (now - self._psnr) / 10

    def due(self, step: int, window: int) -> bool:
        """Whether to copy the weights after `step` steps; the same in all processes."""
        # Rarer in long runs: each copy moves the whole model to the host.
        interval = max(window // 5, min(window, step // 10))
        if step - self._copies[-1][0] < interval or self._psnr is None:
            return False
        self._best = max(self._psnr, self._psnr if self._best is None else self._best)
        return self._psnr >= self._best - LOSS_OF_QUALITY

    def refresh(self, step: int) -> None:
        """Copy the present weights, which `step` optimiser steps made."""
        # Host memory: the device's is needed for the training.
        present = unique_tensors(self._model) if self._keep else {}
        copy = {name: tensor.detach().to("cpu", copy=True) for name, tensor in present.items()}
        self._copies = [*self._copies, (step, copy)][-2:]
        self.step, self.tensors = self._copies[0]

    def state(self) -> dict[str, Any]:
        copies = enumerate(tensors for _, tensors in self._copies)
        tensors = {f"{i}/{name}": t for i, copy in copies for name, t in copy.items()}
        quality = {"psnr": self._psnr, "best": self._best}
        return {"steps": [step for step, _ in self._copies], **quality, **tensors}

    def load_state(self, state: Mapping[str, Any]) -> None:
        self._psnr, self._best, self._copies = state["psnr"], state["best"], []
        for i, step in enumerate(state["steps"]):
            copy = {n.removeprefix(f"{i}/"): t for n, t in state.items() if n.startswith(f"{i}/")}
            self._copies.append((step, copy if self._keep else {}))
        self.step, self.tensors = self._copies[0]


def broken_tensors(model: nn.Module) -> str:
    """Which tensors of `model` hold NaN or infinity; "" if none does."""
    names = nonfinite(unique_tensors(model).items())
    return f"weights are not finite: {listed(names)}" if names else ""


def not_finite(numbers: Mapping[str, float], module: nn.Module) -> str:
    """What is NaN or infinite of a step: loss terms, else the gradient; "" if nothing is."""
    # PSNR is infinite for a perfect image, the gradient is looked at by itself.
    terms = {name: n for name, n in numbers.items() if name not in ("gradient", "psnr")}
    bad = [f"loss term {name} is {n}" for name, n in terms.items() if not math.isfinite(n)]
    if bad or math.isfinite(numbers["gradient"]):
        return ", ".join(bad)
    parameters = module.named_parameters()
    names = nonfinite((name, p.grad) for name, p in parameters if p.grad is not None)
    origin = f", from {listed(names)}" if names else ""
    return f"the gradient norm is {numbers['gradient']}{origin}"
