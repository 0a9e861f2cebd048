"""Steps that are not finite: finding the first bad tensor, and saving what shows it again."""

import json
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import torch
from torch import Tensor, nn

from qgs.checkpoint.model_file import save, unique_tensors
from qgs.checkpoint.tensors import write_tensors
from qgs.containers import named_tensors
from qgs.data.samples import Batch
from qgs.files import write_text
from qgs.model import QueryGaussianModel
from qgs.train.training_pass import TrainingPass

FRAMES = ("scenes", "input_frames", "target_frames")

Report: TypeAlias = Mapping[str, Any]
"""Findings of a process that repeated a step, as JSON values: `process`, its number; `first`, the
fields of its first `BadTensor` or None; `batches`, FRAMES of each."""


class BadTensor(NamedTuple):
    """A tensor with NaN or infinity. batch: which of the step's batches it came up in, from 0."""

    tensor: str
    values: str
    batch: int


def report_of(process: int, first: BadTensor | None, batches: Sequence[Batch]) -> Report:
    """Return the report on a step with `batches`."""
    return {
        "process": process,
        "first": first and first._asdict(),
        "batches": [{name: getattr(batch, name) for name in FRAMES} for batch in batches],
    }


def blames_data(report: Report) -> bool:
    """Return whether the bad tensor came with a batch, and so from nothing that the model did."""
    return bool(report["first"]) and report["first"]["tensor"].startswith(("inputs.", "targets."))


def described(report: Report) -> str:
    """Say in words which tensor was first, and with which samples."""
    first = report["first"]
    if not first:
        return "repeating the step gave finite numbers everywhere"
    batch = report["batches"][first["batch"]]
    samples = ", ".join(
        f"scene {scene!r} (inputs {list(inputs)}, targets {list(targets)})"
        for scene, inputs, targets in zip(*(batch[name] for name in FRAMES), strict=True)
    )
    return f"the first bad tensor is {first['tensor']} ({first['values']}), with {samples}"


def first_bad_tensor(training_pass: TrainingPass, repeat: Callable[[], Any]) -> BadTensor | None:
    """Return the first tensor that is not finite while `repeat` makes a step.

    Torch's anomaly mode would name an operation, not a module; it misses infinities, and raises in
    the middle of a step for which other processes wait.
    """
    watch = _Watch()
    for name, tensor in unique_tensors(training_pass).items():
        watch.see(f"weight {name}", tensor)
    handles = [training_pass.register_forward_pre_hook(watch.see_batch)]
    for name, module in training_pass.named_modules():
        # The renderer runs on detached copies: the pass's own hook shows its output.
        if name.startswith("model.") and module is not training_pass.model.renderer:
            handles.append(module.register_forward_hook(partial(watch.see_output, name)))
    for name, parameter in training_pass.named_parameters():
        if parameter.requires_grad:
            handles.append(parameter.register_hook(partial(watch.see, f"gradient of {name}")))
    before = training_pass.hook
    training_pass.hook = watch.see
    try:
        repeat()
    finally:
        training_pass.hook = before
        for handle in handles:
            handle.remove()
    return watch.first


class _Watch:
    """Notes the first tensor that is not finite, in the order in which a step computes."""

    def __init__(self) -> None:
        self.first: BadTensor | None = None
        self._batch = -1

    def see(self, name: str, value: Any) -> None:
        """Look at `value`: a tensor, or any nest of mappings, sequences and containers of them."""
        for path, tensor in named_tensors(value, name):
            if not self.first and (bad := nonfinite_values(tensor)):
                self.first = BadTensor(path, bad, max(self._batch, 0))

    def see_batch(self, module: nn.Module, arguments: Sequence[Any]) -> None:
        self._batch += 1
        inputs, targets = arguments
        self.see("inputs", inputs)
        self.see("targets", targets)

    def see_output(self, name: str, module: nn.Module, arguments: Any, output: Any) -> None:
        self.see(f"output of {name}", output)
        for path, tensor in named_tensors(output, f"gradient of the output of {name}"):
            # Gradients arrive in reverse order: the first bad one is nearest to the loss.
            if tensor.requires_grad:
                tensor.register_hook(partial(self.see, path))


def nonfinite_values(tensor: Tensor) -> str:
    """Say how many values of `tensor` are NaN and infinite; "" if none is."""
    counts = {"NaN": int(tensor.isnan().sum()), "infinite": int(tensor.isinf().sum())}
    found = [f"{count} {word}" for word, count in counts.items() if count]
    return f"{' and '.join(found)} of {tensor.numel()} values" if found else ""


def save_incident(
    place: Path, model: QueryGaussianModel, step: int, symptom: str, reports: Sequence[Report]
) -> None:
    """Write weights.safetensors, for `qgs.load`, and report.json to `place`."""
    save(model, place / "weights.safetensors", extra={"step": str(step - 1)})
    report = {"step": step, "symptom": symptom, "found": list(reports)}
    # Last: its presence says that the incident is complete.
    write_text(place / "report.json", json.dumps(report, indent=2) + "\n")


def save_batches(path: Path, batches: Sequence[Batch]) -> None:
    """Write the batches of a step, one after the other, as a safetensors file.

    inputs.images, inputs.cameras.c2w and .intrinsics, inputs.masks and .depths where there are
    any, and the same of targets; FRAMES are metadata, in JSON.
    """
    parts: dict[str, list[Tensor]] = {}
    for batch in batches:
        for name, tensor in named_tensors({"inputs": batch.inputs, "targets": batch.targets}):
            parts.setdefault(name, []).append(tensor)
    tensors = {name: torch.cat(pieces) for name, pieces in parts.items()}
    frames = {
        name: json.dumps([shown for batch in batches for shown in getattr(batch, name)])
        for name in FRAMES
    }
    write_tensors(path, tensors, frames)
