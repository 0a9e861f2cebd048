"""What ends a run by itself: a model that died, and steps that are not finite."""

import json
import logging
import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import torch
from accelerate import Accelerator
from accelerate.utils import gather_object
from torch import Tensor, nn

from qgs.composer import Recipe
from qgs.data.sampling import Batch
from qgs.engine.causes import blamed
from qgs.engine.checkpoint import Saver, Weights, number_in
from qgs.engine.distributed import whole
from qgs.engine.objective import TrainingPass
from qgs.io.checkpoint import save, unique_tensors
from qgs.io.files import replacing_entries
from qgs.io.tensors import nonfinite, write_tensors
from qgs.types import named_tensors
from qgs.wording import listed

_log = logging.getLogger(__name__)

EMPTY_ALPHA = 2e-3
"""Mean alpha below which a rendering shows the background alone."""

FLAT = 1 / 255
"""Mean deviation from the background of a rendering that shows nothing else."""

NO_GRADIENT = 1e-8
"""Gradient norm of a model that learns nothing any more."""

MAX_SKIPPED = 10
"""Steps in a row that may be skipped; after them training stops."""

MAX_SAVED = 20
"""Incidents of a run that are saved; later ones are logged and counted."""

_TOO_FAST = {
    "optimizer.learning_rate": "a learning rate too high for this model (lower "
    "optimizer.learning_rate, lengthen optimizer.warmup)"
}

COLLAPSE_CAUSES = _TOO_FAST | {
    "losses.visibility": "a visibility loss too strong or absent (try losses.visibility.weight 0.1 "
    "with behind_camera: invisible)",
    "model.head.opacity_bias": "an initialisation that hides every Gaussian (raise "
    "model.head.opacity_bias)",
    "views.scale": "a scale of the world that leaves none before the cameras (check views.scale "
    "and views.scale_factor against the anchors' and the scenes' depth)",
}
"""By the option that each is about."""

NONFINITE_CAUSES = _TOO_FAST | {
    "training.precision": "a range that bfloat16 does not hold (training.precision: float32)",
    "data": "data that is not finite: images, poses or intrinsics (look at the scenes of `data`; "
    "with views.scale distance, at input cameras that almost stand on one point)",
}


class TrainingError(RuntimeError):
    """Training stopped by itself; the message says why, what is kept and what to do."""


class CollapseError(TrainingError):
    """The model died; the last good weights are kept."""


class NonFiniteError(TrainingError):
    """A step gave NaN or infinity; the run is saved as it was before that step."""


class Guard:
    """Stops a run that is dead or not finite, and sees that good weights are kept.

    All processes must call each of its methods together; `step` counts finished optimiser steps.
    A step that is not finite leaves RUN/incidents/step-N with batch.safetensors (and another
    process's batch-RANK.safetensors), weights.safetensors, for `qgs.load`, and report.json. Batches
    are read with `safetensors.torch.load_file`: inputs.images, inputs.cameras.c2w and .intrinsics,
    inputs.masks where there are any, and the same of targets, all batches of the step one after the
    other; scenes, input_frames and target_frames are metadata, in JSON.

    incidents: steps that were not finite. skipped: how many of them came last, without a good one.
    """

    def __init__(
        self,
        accelerator: Accelerator,
        objective: TrainingPass,
        saver: Saver,
        recipe: Recipe,
        repeat: Callable[[Sequence[Batch]], Any],
    ) -> None:
        """objective: not wrapped by accelerate. repeat: computes the gradients of batches again."""
        config = recipe.training
        self.detector = CollapseDetector(config.collapse_window)
        self.good = GoodWeights(objective.model, keep=accelerator.is_main_process)
        self.incidents = self.skipped = 0
        self._accelerator, self._objective, self._repeat = accelerator, objective, repeat
        self._saver, self._skips = saver, config.on_nonfinite == "skip"
        self._recipe, self._alive = recipe, dict[str, float]()

    def state(self) -> dict[str, Any]:
        detector = self.detector.state()
        counts = {"incidents": self.incidents, "skipped": self.skipped}
        return {**counts, "detector": detector, "alive": self._alive}

    def load_state(self, state: Mapping[str, Any]) -> None:
        self.incidents, self.skipped = (number_in(state, key) for key in ("incidents", "skipped"))
        self.detector.load_state(state["detector"])
        self._alive = {name: float(n) for name, n in state["alive"].items()}

    def passed(self, numbers: Mapping[str, float]) -> None:
        """Take note of a finite step."""
        self.skipped = 0
        self.detector.observe(numbers)
        self.good.observe(numbers)
        if not self.detector.symptom:
            self._alive = dict(numbers)

    def leave_out(self, step: int, batches: Sequence[Batch], symptom: str) -> None:
        """Look into the step after `step`, which is not finite; return to go on without it.

        Raises NonFiniteError, the run saved as before that step, or CollapseError.
        """
        found, in_data = self.look_into(step + 1, batches, symptom)
        if self._skips and self.skipped <= MAX_SKIPPED:
            _log.warning("step %d is skipped: %s", step + 1, found)
            return
        if self.detector.dead_steps or broken_tensors(self._saver.model):
            self._collapse(step + 1, found, NONFINITE_CAUSES)
        self._saver.save(step)
        first = (
            f", after {MAX_SKIPPED} steps in a row were skipped. The run is saved as it was before "
            "this step; continue it with --resume when the cause is gone"
            if self.skipped > MAX_SKIPPED
            else ". To go on without it, repeat the command with `--resume --set "
            "training.on_nonfinite=skip`; the run is saved as it was before this step"
        )
        second = (
            f"The data is to blame, see `qgs data check`: {found}"
            if in_data
            else f"{found}.\nLikely causes:{_as_list(NONFINITE_CAUSES.values())}"
        )
        raise NonFiniteError(f"step {step + 1} is not finite{first}.\n{second}")

    def look_into(self, step: int, batches: Sequence[Batch], symptom: str) -> tuple[str, bool]:
        """Repeat a step to find its first bad tensor; save what it takes to see it again.

        Returns what was found, in words, and whether it came with the images and cameras of a
        batch, and so from nothing that the model did.
        """
        self.incidents += 1
        self.skipped += 1
        watch = Watch()
        with watch.on(self._objective):
            self._repeat(batches)
        first = watch.first._asdict() if watch.first else None
        shown = [{name: getattr(batch, name) for name in _SHOWN} for batch in batches]
        own = {"process": self._accelerator.process_index, "first": first, "batches": shown}
        reports = gather_object([own]) if self._accelerator.num_processes > 1 else [own]
        found = [report for report in reports if report["first"]]
        in_data = [r["first"]["tensor"].startswith(("inputs.", "targets.")) for r in found]
        words = f"{symptom}; {_in_words(found)}; "
        if self.incidents > MAX_SAVED:
            words += f"not saved, as {MAX_SAVED} incidents of this run are"
        else:
            report = {"step": step, "symptom": symptom, "found": reports}
            words += f"batch and weights are in {self._save_incident(step, batches, report, own)}"
        return words, bool(found) and all(in_data)

    def refuse_collapse(self, step: int) -> None:
        """Raise CollapseError when the last steps, a whole window of them, were dead."""
        if self.detector.dead_steps >= self.detector.window:
            symptom = f"for {self.detector.dead_steps} steps {self.detector.symptom}"
            self._collapse(step, symptom, COLLAPSE_CAUSES)

    def keep_good(self, step: int) -> None:
        """Take the weights for good ones, where it is time and the images are as good as before.

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

    def _collapse(self, step: int, problem: str, causes: Mapping[str, str]) -> NoReturn:
        self._saver.save_checkpoint(self.good.step, self.good.tensors)
        alive = self._alive or (None if self.detector.dead_steps else {})
        likely, stands_out = blamed(self._recipe, alive, self._objective.owners)
        others = [text for option, text in causes.items() if option not in likely]
        told = _as_list([likely, *([] if stands_out else others)])
        raise CollapseError(
            f"training collapsed at step {step}: {problem}. The weights of step {self.good.step} "
            f"are kept in {self._saver.folder.checkpoint}. Likely causes:{told}"
        )

    def _save_incident(
        self, step: int, batches: Sequence[Batch], report: Mapping[str, Any], own: Mapping[str, Any]
    ) -> Path:
        name, model = f"step-{step}", self._saver.model
        place = self._saver.folder.path / "incidents" / name
        weights = Weights(model).state()
        if self._accelerator.is_main_process:
            self._saver.folder.refuse_gone()
            with replacing_entries(place.parent) as fresh:
                _write_batches(fresh / name / "batch.safetensors", batches)
                path = fresh / name / "weights.safetensors"
                save(model, path, extra={"step": str(step - 1)}, weights=weights)
                text = json.dumps(report, indent=2) + "\n"
                (fresh / name / "report.json").write_text(text, encoding="utf-8")
        self._accelerator.wait_for_everyone()
        if own["first"] and not self._accelerator.is_main_process:
            _write_batches(place / f"batch-{own['process']}.safetensors", batches)
        self._accelerator.wait_for_everyone()
        return place


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
        elif self._has_drawn and numbers["deviation"] < FLAT:
            self.symptom = "the renderings equal the background"
        self.dead_steps = self.dead_steps + 1 if self.symptom else 0
        self._has_drawn |= numbers["deviation"] > 8 * FLAT

    def dead_after(self, steps: int) -> bool:
        """Whether all of a run's `steps` so far, or the whole window, were dead."""
        return self.dead_steps >= min(self.window, steps)

    def state(self) -> dict[str, Any]:
        return {"dead": self.dead_steps, "symptom": self.symptom, "has_drawn": self._has_drawn}

    def load_state(self, state: Mapping[str, Any]) -> None:
        self.dead_steps, self.symptom = number_in(state, "dead"), str(state["symptom"])
        self._has_drawn = bool(number_in(state, "has_drawn", bool))


LOSS_OF_QUALITY = 1.0
"""dB below the best PSNR so far, means of some ten steps, at which weights are no longer good."""


class GoodWeights:
    """Copies in host memory of the weights at the last two times that the model was healthy.

    A collapse is noticed late, and the newer copy may already be on its way down; `tensors` after
    `step` optimiser steps are the older one. Copies lie a fifth of a window apart at first and a
    window in long runs, and none is made while the images are worse than they were.

    keep: whether this process holds the copies; one of several suffices.
    """

    def __init__(self, model: nn.Module, keep: bool = True) -> None:
        self._weights, self._keep = Weights(model), keep
        self._copies: list[tuple[int, dict[str, Tensor]]] = []
        self._psnr: float | None = None
        self._best: float | None = None
        self.refresh(0)

    def observe(self, numbers: Mapping[str, float]) -> None:
        """Take note of a step's "psnr", in dB."""
        now = numbers["psnr"]
        self._psnr = now if self._psnr is None else self._psnr + (now - self._psnr) / 10

    def due(self, step: int, window: int) -> bool:
        """Whether the weights after `step` steps are to be copied. All processes say the same."""
        apart = max(window // 5, min(window, step // 10))
        if step - self._copies[-1][0] < apart or self._psnr is None:
            return False
        self._best = max(self._psnr, self._psnr if self._best is None else self._best)
        return self._psnr >= self._best - LOSS_OF_QUALITY

    def refresh(self, step: int) -> None:
        """Copy the present weights, which `step` optimiser steps made. All processes must call."""
        present = self._weights.state()
        copy = {n: t.to("cpu", copy=True) for n, t in present.items()} if self._keep else {}
        self._copies = [*self._copies, (step, copy)][-2:]
        self.step, self.tensors = self._copies[0]

    def state(self) -> dict[str, Any]:
        copies = enumerate(tensors for _, tensors in self._copies)
        tensors = {f"{i}/{name}": t for i, copy in copies for name, t in copy.items()}
        quality = {"psnr": self._psnr, "best": self._best}
        return {"steps": [step for step, _ in self._copies], **quality, **tensors}

    def load_state(self, state: Mapping[str, Any]) -> None:
        self._copies = []
        quality = (state[name] for name in ("psnr", "best"))
        self._psnr, self._best = (None if value is None else float(value) for value in quality)
        for i, step in enumerate(state["steps"]):
            copy = {n.removeprefix(f"{i}/"): t for n, t in state.items() if n.startswith(f"{i}/")}
            self._weights.refuse_unlike(copy)
            step = number_in({"steps": step}, "steps")
            self._copies.append((step, copy if self._keep else {}))
        self.step, self.tensors = self._copies[0]


def broken_tensors(model: nn.Module) -> str:
    """Which tensors of `model` hold NaN or infinity; "" if none does."""
    names = nonfinite((name, whole(t)) for name, t in unique_tensors(model).items())
    return f"weights are not finite: {listed(names)}" if names else ""


def not_finite(numbers: Mapping[str, float], module: nn.Module) -> str:
    """What is NaN or infinite of a step: loss terms, else the gradient; "" if nothing is."""
    terms = {name: n for name, n in numbers.items() if name not in ("gradient", "psnr")}
    bad = [f"loss term {name} is {n}" for name, n in terms.items() if not math.isfinite(n)]
    if bad or math.isfinite(numbers["gradient"]):
        return ", ".join(bad)
    parameters = module.named_parameters()
    names = nonfinite((name, p.grad) for name, p in parameters if p.grad is not None)
    origin = f", from {listed(names)}" if names else ""
    return f"the gradient norm is {numbers['gradient']}{origin}"


def _in_words(found: Sequence[Mapping[str, Any]]) -> str:
    """The first bad tensors of processes, each with the batch that it came up in."""
    if not found:
        return "repeating the step gave finite numbers everywhere"
    sentences = []
    for report in found:
        bad = BadTensor(**report["first"])
        batch = report["batches"][bad.batch]
        samples = [
            f"scene {scene!r} (inputs {list(inputs)}, targets {list(targets)})"
            for scene, inputs, targets in zip(*(batch[name] for name in _SHOWN), strict=True)
        ]
        sentences.append(f"the first bad tensor is {bad}, with {', '.join(samples)}")
    return "; ".join(sentences)


class BadTensor(NamedTuple):
    """A tensor with NaN or infinity. batch: which of the step's batches it came up in, from 0."""

    tensor: str
    values: str
    batch: int

    def __str__(self) -> str:
        return f"{self.tensor} ({self.values})"


class Watch:
    """Notes the first tensor that is not finite, in the order in which a step computes."""

    def __init__(self) -> None:
        self.first: BadTensor | None = None
        self._batch = -1
        self._calls: Counter[str] = Counter()

    def see(self, name: str, value: Any) -> None:
        """Look at `value`: a tensor, or any nest of mappings, sequences and containers of them."""
        for path, tensor in named_tensors(value, name):
            if not self.first and (bad := nonfinite_values(tensor)):
                self.first = BadTensor(path, bad, max(self._batch, 0))

    @contextmanager
    def on(self, objective: TrainingPass) -> Iterator[None]:
        """Watch the steps that `objective` makes inside the `with` block."""
        for name, tensor in unique_tensors(objective).items():
            self.see(f"weight {name}", whole(tensor))
        handles = [objective.register_forward_pre_hook(self._see_batch)]
        for name, module in objective.named_modules():
            if name.startswith("model.") and module is not objective.model.renderer:
                handles.append(module.register_forward_hook(partial(self._see_output, name)))
        for name, parameter in objective.named_parameters():
            if parameter.requires_grad:
                handles.append(parameter.register_hook(partial(self.see, f"gradient of {name}")))
        before, objective.hook = objective.hook, self.see
        try:
            yield
        finally:
            objective.hook = before
            for handle in handles:
                handle.remove()

    def _see_batch(self, module: nn.Module, arguments: tuple[Any, ...]) -> None:
        self._batch += 1
        self._calls.clear()
        for name, views in zip(("inputs", "targets"), arguments, strict=True):
            self.see(name, views)

    def _see_output(self, name: str, module: nn.Module, arguments: Any, output: Any) -> None:
        self._calls[name] += 1
        call = f" (call {self._calls[name]})" if self._calls[name] > 1 else ""
        self.see(f"output{call} of {name}", output)
        for path, tensor in named_tensors(output, f"gradient of the output{call} of {name}"):
            if tensor.requires_grad:
                tensor.register_hook(partial(self.see, path))


def nonfinite_values(tensor: Tensor) -> str:
    """How many values of `tensor` are NaN and infinite; "" if none is."""
    tensor = tensor.detach()
    if not tensor.is_floating_point() or bool(torch.isfinite(tensor).all()):
        return ""
    nan, infinite = int(torch.isnan(tensor).sum()), int(torch.isinf(tensor).sum())
    counts = [f"{n} {word}" for n, word in ((nan, "NaN"), (infinite, "infinite")) if n]
    return f"{' and '.join(counts)} of {tensor.numel()} values"


_SHOWN = ("scenes", "input_frames", "target_frames")


def _write_batches(path: Path, batches: Sequence[Batch]) -> None:
    """Write batches of one shape, one after the other, as a safetensors file."""
    parts: dict[str, list[Tensor]] = {}
    for batch in batches:
        for name, tensor in named_tensors({"inputs": batch.inputs, "targets": batch.targets}):
            parts.setdefault(name, []).append(tensor)
    shown = {name: json.dumps([i for b in batches for i in getattr(b, name)]) for name in _SHOWN}
    write_tensors(path, {name: torch.cat(tensors) for name, tensors in parts.items()}, shown)
