"""Checks that stop a training run: collapse, NaN or infinity in a step, and too little memory."""

import logging
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any, NoReturn

from accelerate import PartialState
from accelerate.utils import gather_object
from torch import nn

from qgs.checkpoint.model_file import unique_tensors
from qgs.checkpoint.tensors import Weights, copied, nonfinite
from qgs.containers import named_tensors
from qgs.contracts import TrainingConfig
from qgs.data.samples import Batch
from qgs.machine import is_out_of_memory
from qgs.train.folder import Saver, State
from qgs.train.training_pass import TrainingPass
from qgs.wording import listed

_log = logging.getLogger(__name__)

EMPTY_ALPHA = 2e-3
"""Mean alpha of a rendering below which it counts as empty: it shows only the background."""

FLAT = 1 / 255
"""Mean |rgb - background| of a rendering below which it counts as flat background."""

NO_GRADIENT = 1e-8
"""Gradient norm below which a model no longer learns."""

LOSS_OF_QUALITY = 1.0
"""Largest drop in dB below the best PSNR so far at which weights still count as good.

The present and the best PSNR are running means of about ten steps.
"""

MAX_SKIPPED = 10
"""Largest number of steps in a row that are skipped. One more stops training."""

_TOO_FAST = (
    "\n  - a learning rate too high for this model (lower optimizer.learning_rate, lengthen "
    "optimizer.warmup)"
)

COLLAPSE_CAUSES = (
    f"{_TOO_FAST}"
    "\n  - a visibility loss that is too strong or missing (try losses.visibility.weight 0.1 with "
    "behind_camera: invisible)"
    "\n  - an initialisation that hides every Gaussian (raise model.head.opacity_bias)"
    "\n  - a scale of the world that leaves no Gaussian in front of the cameras (compare "
    "views.scale and views.scale_factor with the depths of the anchors and the scenes)"
)

NONFINITE_CAUSES = (
    f"{_TOO_FAST}"
    "\n  - numbers outside the range of bfloat16 (set training.precision to float32)"
    "\n  - images, poses or intrinsics that are not finite (run `qgs data check`; with views.scale "
    "distance, look for input cameras at almost the same point)"
)


class TrainingError(RuntimeError):
    """Error that stops training; the message says why, what is kept and what to do."""


class CollapseError(TrainingError):
    """Error for a model that no longer renders or learns; the last good weights are kept."""


class NonFiniteError(TrainingError):
    """Error for a step with NaN or infinity; the run was saved as it was before this step."""


class OutOfMemoryError(TrainingError):
    """Error for a step that ran out of memory; the message says what is kept and what helps."""


@dataclass
class Guard:
    """Guard that stops a run whose model is dead or whose values are not finite.

    It keeps copies of the last good weights. A model is dead if it no longer renders or learns, see
    `SignsOfLife`. All processes must call each method together. `step` is the number of finished
    optimiser steps. Methods that save raise CollapseError if weights are not finite.

    training_pass: the module, not wrapped by accelerate. repeat: function that computes the
        gradients of a step again. skipped: number of latest steps in a row that were not finite.
    """

    training_pass: TrainingPass
    saver: Saver
    config: TrainingConfig
    repeat: Callable[[Sequence[Batch]], Any]
    skipped: int = 0

    def __post_init__(self) -> None:
        self.signs = SignsOfLife()
        self.good = GoodWeights(self.training_pass.model)

    def state(self) -> State:
        return {"skipped": self.skipped, "detector": asdict(self.signs)}

    def load_state(self, state: State) -> None:
        self.skipped = state["skipped"]
        self.signs = SignsOfLife(**state["detector"])

    def refuse_nonfinite(self, step: int, batches: Sequence[Batch], symptom: str) -> None:
        """Skip a step with NaN or infinity, or raise an error for it; `step` steps are finished.

        The gradients of the step are computed again to find the first tensor that is not finite.
        With on_nonfinite "skip", up to MAX_SKIPPED steps in a row are skipped with a warning.
        Otherwise raises NonFiniteError after saving the run as it was before the step, or
        CollapseError if the model did not render or learn in the latest finite step. symptom: text
        that names the numbers that are not finite.
        """
        self.skipped += 1
        # All processes repeat the step: its collective operations need everyone.
        first = first_bad_tensor(self.training_pass, batches, lambda: self.repeat(batches))
        found = "; ".join(filter(None, [symptom, *gather_object([first])]))
        if self.config.on_nonfinite == "skip" and self.skipped <= MAX_SKIPPED:
            _log.warning("step %d is skipped: %s", step + 1, found)
            return
        # A model that was dying gave this NaN: going on from here would not help.
        if self.signs.dead:
            self._collapse(step + 1, found)
        self.save(step)
        raise NonFiniteError(
            f"step {step + 1} has NaN or infinity; the run is saved as it was before this step. "
            "Continue without it by `--resume --set training.on_nonfinite=skip`, which skips at "
            f"most {MAX_SKIPPED} steps in a row.\n{found}.\nLikely causes:{NONFINITE_CAUSES}"
        )

    def watch(self, step: int, numbers: Mapping[str, float]) -> None:
        """Record the numbers of `step`, all finite. If the model is healthy, copy weights when due.

        Raises CollapseError if the model was dead in each of the last `training.collapse_window`
        steps, or if weights to copy are not finite.
        """
        self.skipped = 0
        self.signs.observe(numbers)
        self.good.observe(numbers)
        window = self.config.collapse_window
        if self.signs.dead >= window:
            self._collapse(step)
        if not self.signs.dead and self.good.due(step, window):
            self._refuse_broken_weights(step)
            self.good.refresh(step)

    def save(self, step: int, ends: bool = False) -> None:
        """Save the run; if the model has collapsed, the checkpoint gets the last healthy weights.

        ends: whether the training budget is used up; a collapsed model then raises CollapseError.
        """
        # A run shorter than a window is dead when all of its steps were.
        if self.signs.dead < min(self.config.collapse_window, step):
            self._refuse_broken_weights(step)
            self.saver.save(step)
        elif ends:
            self._collapse(step)
        else:
            # The state keeps the dead weights: a resumed run must equal an uninterrupted one.
            self.saver.save(step, self.good.last)

    @contextmanager
    def memory_explained(self, step: int, saves: bool = False) -> Iterator[None]:
        """Raise OutOfMemoryError if the block runs out of memory.

        saves: whether to try to save the run first. Use it only for blocks that do not change
            weights. Runs with several processes are not saved.
        """
        try:
            yield
        except Exception as error:
            if not is_out_of_memory(error):
                raise
            # Saving may fail too, but the files of the last save stay complete. With several
            # processes this one would wait for the others forever.
            if saves and step and PartialState().num_processes == 1:
                with suppress(Exception):
                    self.save(step)
            raise OutOfMemoryError(
                f"out of memory in step {step + 1}: {str(error).splitlines()[0][:300]}. "
                "Continue the saved run with --resume and a higher training.accumulate, more "
                "processes, or a lower training.render_views. A new run needs less memory with "
                "lower views.inputs, views.targets, training.batch_size, data.image_size, "
                "model.queries.count or model.head.gaussians_per_query."
            ) from error

    def _refuse_broken_weights(self, step: int) -> None:
        if names := nonfinite(unique_tensors(self.saver.model)):
            self._collapse(step, f"weights are not finite: {listed(names)}")

    def _collapse(self, step: int, problem: str = "") -> NoReturn:
        """Save the last good weights and raise CollapseError.

        problem: what is not finite, for the message; "" if the model does not render or learn.
        """
        causes = NONFINITE_CAUSES if problem else COLLAPSE_CAUSES
        problem = problem or f"for the last {self.signs.dead} steps {self.signs.symptom}"
        good, weights = self.good.last
        self.saver.save_checkpoint(good, weights)
        raise CollapseError(
            f"training collapsed at step {step}: {problem}. The weights of step {good} "
            f"are kept in {self.saver.folder.checkpoint}. Likely causes:{causes}"
        )


@dataclass
class SignsOfLife:
    """Counter of dead steps, in which the model does not render or learn.

    A step is dead if the rendering is empty (mean alpha below EMPTY_ALPHA), if the gradient has
    vanished (norm below NO_GRADIENT), or if the images show only the background although earlier
    images showed more.
    dead: number of latest steps in a row that were dead. symptom: why the latest step was dead,
        else "". has_drawn: whether an earlier image clearly differed from the background.
    """

    dead: int = 0
    symptom: str = ""
    has_drawn: bool = False

    def observe(self, numbers: Mapping[str, float]) -> None:
        """Update all fields by a step's numbers: "alpha", "deviation" and "gradient" (norm)."""
        self.symptom = ""
        if numbers["alpha"] < EMPTY_ALPHA:
            self.symptom = f"the renderings are empty (mean alpha {numbers['alpha']:.1e})"
        elif numbers["gradient"] < NO_GRADIENT:
            self.symptom = f"the gradient has vanished (norm {numbers['gradient']:.1e})"
        # At the start plain images are normal: queries have not found the scene yet.
        elif self.has_drawn and numbers["deviation"] < FLAT:
            self.symptom = "the renderings equal the background"
        self.dead = self.dead + 1 if self.symptom else 0
        # Well above FLAT, so that noise around the threshold does not count as an image.
        self.has_drawn |= numbers["deviation"] > 8 * FLAT


@dataclass
class GoodWeights:
    """Copies of the weights in host memory from the last two times that the model was healthy.

    A collapse is noticed late, so the newer copy may already be damaged, and only the older copy is
    trusted. The interval between copies is a fifth of `training.collapse_window` at first, and
    grows to the whole window in long runs. A copy that is due is not made while `psnr` is more than
    LOSS_OF_QUALITY below `best`.

    Only the main process holds copies. psnr: running mean of the steps' PSNR in dB. best: largest
    `psnr` at the steps at which a copy was due.
    """

    model: nn.Module
    psnr: float | None = None
    best: float | None = None

    def __post_init__(self) -> None:
        self.copies: list[tuple[int, Weights]] = []
        self.refresh(0)

    @property
    def last(self) -> tuple[int, Weights]:
        """Older of the two copies: number of optimiser steps when it was made, and its weights."""
        return self.copies[0]

    def observe(self, numbers: Mapping[str, float]) -> None:
        """Update the running mean of PSNR by a step's "psnr", in dB."""
        # The PSNR of one batch depends on its scenes, so running means are compared.
        psnr = numbers["psnr"]
        self.psnr = psnr if self.psnr is None else self.psnr + (psnr - self.psnr) / 10

    def due(self, step: int, window: int) -> bool:
        """Return whether to copy the weights after `step` steps.

        True if the last copy is an interval old, and the mean PSNR is at most LOSS_OF_QUALITY below
        `best`. window: `training.collapse_window`, in steps. All processes get the same result.
        """
        # Rarer in long runs: each copy moves the whole model to the host.
        interval = max(window // 5, min(window, step // 10))
        newest, _ = self.copies[-1]
        if step - newest < interval or self.psnr is None:
            return False
        self.best = self.psnr if self.best is None else max(self.psnr, self.best)
        return self.psnr >= self.best - LOSS_OF_QUALITY

    def refresh(self, step: int) -> None:
        """Copy the present weights, reached after `step` steps; keep the two latest copies."""
        present = unique_tensors(self.model) if PartialState().is_main_process else {}
        # In host memory, because training needs the device's.
        self.copies = [*self.copies, (step, copied(present))][-2:]

    def state(self) -> State:
        return {"psnr": self.psnr, "best": self.best, "copies": dict(self.copies)}

    def load_state(self, state: State) -> None:
        self.psnr = state["psnr"]
        self.best = state["best"]
        # The keys of JSON are strings.
        self.copies = [(int(step), copy) for step, copy in state["copies"].items()]


def not_finite(numbers: Mapping[str, float]) -> str:
    """Return text that names the NaN or infinite numbers of a step; "" if there are none."""
    # PSNR is infinite for a perfect image.
    bad = [f"{k} is {n}" for k, n in numbers.items() if k != "psnr" and not math.isfinite(n)]
    return ", ".join(bad)


def first_bad_tensor(
    training_pass: nn.Module, batches: Sequence[Batch], repeat: Callable[[], Any]
) -> str:
    """Return text on the first tensor that is not finite while `repeat` computes a step.

    The text names the tensor and the samples of its batch; it is "" if all tensors are finite.
    Torch's anomaly mode is not used: it names an operation, not a module, misses infinities, and
    raises in the middle of a step while other processes wait.
    """
    found: list[str] = []
    coming = iter(batches)
    batch = batches[0]

    def see(name: str, value: Any) -> None:
        """Look for NaN and infinity in the tensors of `value`, which messages call `name`."""
        for path, tensor in named_tensors(value, name):
            bad = tensor[~tensor.isfinite()]
            if bad.numel() and not found:
                values = f"{bad.numel()} of {tensor.numel()} values, the first {bad[0].item()}"
                found.append(f"the first bad tensor is {path} ({values}), with {_samples(batch)}")

    def see_batch(module: nn.Module, arguments: Sequence[Any]) -> None:
        nonlocal batch
        batch = next(coming)
        inputs, targets = arguments
        see("inputs", inputs)
        see("targets", targets)

    def see_output(name: str, module: nn.Module, arguments: Any, output: Any) -> None:
        see(f"output of {name}", output)
        for path, tensor in named_tensors(output, f"gradient of the output of {name}"):
            # Gradients arrive in reverse order: the first bad one is nearest to the loss.
            if tensor.requires_grad:
                tensor.register_hook(partial(see, path))

    for name, tensor in unique_tensors(training_pass).items():
        see(f"weight {name}", tensor)
    with ExitStack() as hooks:
        hooks.enter_context(training_pass.register_forward_pre_hook(see_batch))
        for name, module in training_pass.named_modules():
            if name:
                hooks.enter_context(module.register_forward_hook(partial(see_output, name)))
        for name, parameter in training_pass.named_parameters():
            if parameter.requires_grad:
                hooks.enter_context(parameter.register_hook(partial(see, f"gradient of {name}")))
        repeat()
    return "".join(found)


def _samples(batch: Batch) -> str:
    return ", ".join(
        f"scene {scene!r} (inputs {list(inputs)}, targets {list(targets)})"
        for scene, (inputs, targets) in zip(batch.scenes, batch.windows, strict=True)
    )
