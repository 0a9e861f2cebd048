"""Automatic ends of a run: collapsed models and steps that are not finite."""

import logging
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any, NoReturn

from accelerate import PartialState
from accelerate.utils import gather_object
from torch import Tensor, nn

from qgs.checkpoint.model_file import unique_tensors
from qgs.checkpoint.tensors import nonfinite
from qgs.containers import named_tensors
from qgs.contracts import TrainingConfig
from qgs.data.samples import Batch
from qgs.machine import is_out_of_memory
from qgs.train.folder import Saver
from qgs.train.training_pass import TrainingPass
from qgs.wording import listed

_log = logging.getLogger(__name__)

EMPTY_ALPHA = 2e-3
"""Mean alpha below which a rendering shows the background alone."""

FLAT = 1 / 255
"""Mean deviation from the background of a rendering that shows nothing else."""

NO_GRADIENT = 1e-8
"""Gradient norm below which a model no longer learns."""

LOSS_OF_QUALITY = 1.0
"""Drop below the best running mean of PSNR, in dB, at which weights no longer count as good."""

MAX_SKIPPED = 10
"""Steps in a row that may be skipped; after them training stops."""

_TOO_FAST = (
    "\n  - a learning rate too high for this model (lower optimizer.learning_rate, lengthen "
    "optimizer.warmup)"
)

COLLAPSE_CAUSES = (
    f"{_TOO_FAST}"
    "\n  - a visibility loss too strong or absent (try losses.visibility.weight 0.1 with "
    "behind_camera: invisible)"
    "\n  - an initialisation that hides every Gaussian (raise model.head.opacity_bias)"
    "\n  - a scale of the world that leaves none before the cameras (check views.scale and "
    "views.scale_factor against the anchors' and the scenes' depth)"
)

NONFINITE_CAUSES = (
    f"{_TOO_FAST}"
    "\n  - a range that bfloat16 does not hold (training.precision: float32)"
    "\n  - data that is not finite: images, poses or intrinsics (look at it with `qgs data check`; "
    "with views.scale distance, at input cameras that almost stand on one point)"
)


class TrainingError(RuntimeError):
    """Error that stops a training; the message says why, what is kept and what to do."""


class CollapseError(TrainingError):
    """Error: the model collapsed; the last good weights are kept."""


class NonFiniteError(TrainingError):
    """Error: a step gave NaN or infinity; the run is saved as it was before that step."""


class OutOfMemoryError(TrainingError):
    """Error: a step ran out of memory; the message says what is kept and what needs less."""


@dataclass
class Guard:
    """Guard that stops a collapsed or non-finite run and keeps good weights.

    All processes must call each of its methods together; `step` counts finished optimiser steps.
    What saves raises CollapseError for weights that are not finite.

    training_pass: not wrapped by accelerate. repeat: computes the gradients of a step again.
    skipped: the latest steps in a row that were not finite.
    """

    training_pass: TrainingPass
    saver: Saver
    config: TrainingConfig
    repeat: Callable[[Sequence[Batch]], Any]
    skipped: int = 0

    def __post_init__(self) -> None:
        self.signs = SignsOfLife()
        self.good = GoodWeights(self.training_pass.model)

    def state(self) -> dict[str, Any]:
        return {"skipped": self.skipped, "detector": asdict(self.signs)}

    def load_state(self, state: Mapping[str, Any]) -> None:
        self.skipped = state["skipped"]
        self.signs = SignsOfLife(**state["detector"])

    def refuse_nonfinite(self, step: int, batches: Sequence[Batch], symptom: str) -> None:
        """Raise about the step after `step`, which is not finite, unless it is to be skipped.

        It is repeated to name the first bad tensor. Raises NonFiniteError, the run saved as before
        that step, or CollapseError; logs a warning where the step is skipped.
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
            f"step {step + 1} is not finite, and the run is saved as it was before this step; "
            "continue without it by `--resume --set training.on_nonfinite=skip`, which skips at "
            f"most {MAX_SKIPPED} steps in a row.\n{found}.\nLikely causes:{NONFINITE_CAUSES}"
        )

    def watch(self, step: int, numbers: Mapping[str, float]) -> None:
        """Record the finite numbers of `step`; copy the weights if they are good and a copy is due.

        Raises CollapseError when the last steps, a whole window of them, were dead, and for weights
        to copy that are not finite.
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
        """Save the run; a dead model's checkpoint is the last good one.

        ends: the budget is used. Raises CollapseError for a dead model then.
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
        """Raise OutOfMemoryError where the block finds no memory; saves: weights are untouched."""
        try:
            yield
        except Exception as error:
            if not is_out_of_memory(error):
                raise
            # Saving takes memory too; the files of the last save are whole in any case. With
            # several processes the others would wait for this one in vain.
            if saves and step and PartialState().num_processes == 1:
                with suppress(Exception):
                    self.save(step)
            raise OutOfMemoryError(
                f"out of memory in step {step + 1}: {str(error).splitlines()[0][:300]}. "
                "What was saved continues with --resume and a higher training.accumulate, more "
                "processes, or fewer training.render_views. A new run also takes less when you "
                "lower views.inputs, views.targets, training.batch_size, data.image_size, "
                "model.queries.count or model.head.gaussians_per_query."
            ) from error

    def _refuse_broken_weights(self, step: int) -> None:
        if names := nonfinite(unique_tensors(self.saver.model)):
            self._collapse(step, f"weights are not finite: {listed(names)}")

    def _collapse(self, step: int, problem: str = "") -> NoReturn:
        """Keep good weights and raise. problem: what is not finite; dead steps by default."""
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
    """Signs of life of the latest steps. dead: steps in a row without any, because of `symptom`.

    A step is dead when nothing is drawn (mean alpha under EMPTY_ALPHA), when no gradient is left,
    or when the images have gone back to the plain background after showing more.
    """

    dead: int = 0
    symptom: str = ""
    has_drawn: bool = False

    def observe(self, numbers: Mapping[str, float]) -> None:
        """Record a step: "alpha" and "deviation" of its renderings, "gradient" (norm)."""
        self.symptom = ""
        if numbers["alpha"] < EMPTY_ALPHA:
            self.symptom = f"the renderings are empty (mean alpha {numbers['alpha']:.1e})"
        elif numbers["gradient"] < NO_GRADIENT:
            self.symptom = f"the gradient has vanished (norm {numbers['gradient']:.1e})"
        # At the start plain images are normal: queries have not found the scene yet.
        elif self.has_drawn and numbers["deviation"] < FLAT:
            self.symptom = "the renderings equal the background"
        self.dead = self.dead + 1 if self.symptom else 0
        # Well above FLAT, so that noise around the threshold is no image.
        self.has_drawn |= numbers["deviation"] > 8 * FLAT


@dataclass
class GoodWeights:
    """Copies in host memory of the weights at the last two times that the model was healthy.

    A collapse is noticed late, and the newer copy may already be on its way down, so the older one
    is the last that is surely good. Copies are made every fifth of a window at first and a window
    in long runs, and none is made while the images are worse than they were.

    Of several processes the main one holds them. psnr, best: its running mean, in dB, and the
    largest one at a copy.
    """

    model: nn.Module
    psnr: float | None = None
    best: float | None = None

    def __post_init__(self) -> None:
        self.copies: list[tuple[int, Mapping[str, Tensor]]] = []
        self.refresh(0)

    @property
    def last(self) -> tuple[int, Mapping[str, Tensor]]:
        """Optimiser steps, and the weights that they made."""
        return self.copies[0]

    def observe(self, numbers: Mapping[str, float]) -> None:
        """Record a step's "psnr", in dB."""
        # PSNR of one batch depends on its scenes: compare running means.
        psnr = numbers["psnr"]
        self.psnr = psnr if self.psnr is None else self.psnr + (psnr - self.psnr) / 10

    def due(self, step: int, window: int) -> bool:
        """Return whether to copy the weights after `step` steps; the same in all processes."""
        # Rarer in long runs: each copy moves the whole model to the host.
        interval = max(window // 5, min(window, step // 10))
        newest, _ = self.copies[-1]
        if step - newest < interval or self.psnr is None:
            return False
        self.best = self.psnr if self.best is None else max(self.psnr, self.best)
        return self.psnr >= self.best - LOSS_OF_QUALITY

    def refresh(self, step: int) -> None:
        """Copy the present weights, which `step` optimiser steps made."""
        present = unique_tensors(self.model) if PartialState().is_main_process else {}
        # Host memory: the device's is needed for the training.
        copy = {name: tensor.detach().to("cpu", copy=True) for name, tensor in present.items()}
        self.copies = [*self.copies, (step, copy)][-2:]

    def state(self) -> dict[str, Any]:
        found: dict[str, Any] = {"psnr": self.psnr, "best": self.best}
        found["steps"] = [step for step, _ in self.copies]
        for number, (_, copy) in enumerate(self.copies):
            found |= {f"{number}/{name}": tensor for name, tensor in copy.items()}
        return found

    def load_state(self, state: Mapping[str, Any]) -> None:
        self.psnr = state["psnr"]
        self.best = state["best"]
        self.copies = []
        for number, step in enumerate(state["steps"]):
            prefix = f"{number}/"
            copy = {k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)}
            self.copies.append((step, copy))


def not_finite(numbers: Mapping[str, float]) -> str:
    """Name which numbers of a step are NaN or infinite; "" if none is."""
    # PSNR is infinite for a perfect image.
    bad = [f"{k} is {n}" for k, n in numbers.items() if k != "psnr" and not math.isfinite(n)]
    return ", ".join(bad)


def first_bad_tensor(
    training_pass: nn.Module, batches: Sequence[Batch], repeat: Callable[[], Any]
) -> str:
    """Name the first tensor that is not finite while `repeat` makes a step of `batches`, if any.

    In words, with the samples of its batch; "" for none.
    Torch's anomaly mode would name an operation, not a module; it misses infinities, and raises in
    the middle of a step for which other processes wait.
    """
    watch = _Watch(batches)
    for name, tensor in unique_tensors(training_pass).items():
        watch.see(f"weight {name}", tensor)
    handles = [training_pass.register_forward_pre_hook(watch.see_batch)]
    for name, module in training_pass.named_modules():
        if name:
            handles.append(module.register_forward_hook(partial(watch.see_output, name)))
    for name, parameter in training_pass.named_parameters():
        if parameter.requires_grad:
            handles.append(parameter.register_hook(partial(watch.see, f"gradient of {name}")))
    try:
        repeat()
    finally:
        for handle in handles:
            handle.remove()
    return watch.found


class _Watch:
    """Description of the first tensor that is not finite, in the order of computation."""

    def __init__(self, batches: Sequence[Batch]) -> None:
        self.found = ""
        self._batch = batches[0]
        self._coming = iter(batches)

    def see(self, name: str, value: Any) -> None:
        """Look at `value`: a tensor, or any nest of mappings, sequences and containers of them."""
        for path, tensor in named_tensors(value, name):
            bad = tensor[~tensor.isfinite()]
            if bad.numel() and not self.found:
                values = f"{bad.numel()} of {tensor.numel()} values, the first {bad[0].item()}"
                self.found = f"the first bad tensor is {path} ({values}), with {self._samples()}"

    def _samples(self) -> str:
        batch = self._batch
        drawn = zip(batch.scenes, batch.input_frames, batch.target_frames, strict=True)
        return ", ".join(
            f"scene {scene!r} (inputs {list(inputs)}, targets {list(targets)})"
            for scene, inputs, targets in drawn
        )

    def see_batch(self, module: nn.Module, arguments: Sequence[Any]) -> None:
        self._batch = next(self._coming)
        inputs, targets = arguments
        self.see("inputs", inputs)
        self.see("targets", targets)

    def see_output(self, name: str, module: nn.Module, arguments: Any, output: Any) -> None:
        self.see(f"output of {name}", output)
        for path, tensor in named_tensors(output, f"gradient of the output of {name}"):
            # Gradients arrive in reverse order: the first bad one is nearest to the loss.
            if tensor.requires_grad:
                tensor.register_hook(partial(self.see, path))
