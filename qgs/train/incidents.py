"""Steps that are not finite: finding the first bad tensor, and saving what shows it again."""

import json
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

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


class BadTensor(NamedTuple):
    """A tensor with NaN or infinity. batch: which of the step's batches it came up in, from 0."""

    tensor: str
    values: str
    batch: int


class Report(NamedTuple):
    """What a process found when it repeated a step: its first bad tensor, None without one.

    batches: scenes, input_frames and target_frames of each batch of the process.
    """

    process: int
    first: BadTensor | None
    batches: Sequence[Mapping[str, Any]]

    @classmethod
    def of(cls, process: int, first: BadTensor | None, batches: Sequence[Batch]) -> "Report":
        """The report on a step with `batches`."""
        return cls(process, first, [{n: getattr(batch, n) for n in FRAMES} for batch in batches])

    @property
    def blames_data(self) -> bool:
        """Whether the bad tensor came with a batch, and so from nothing that the model did."""
        return self.first is not None and self.first.tensor.startswith(("inputs.", "targets."))

    def __str__(self) -> str:
        if self.first is None:
            return "repeating the step gave finite numbers everywhere"
        batch = self.batches[self.first.batch]
        samples = ", ".join(
            f"scene {scene!r} (inputs {list(inputs)}, targets {list(targets)})"
            for scene, inputs, targets in zip(*(batch[name] for name in FRAMES), strict=True)
        )
        return f"the first bad tensor is {self.first.tensor} ({self.first.values}), with {samples}"

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return {**self._asdict(), "first": self.first and self.first._asdict()}


def first_bad_tensor(objective: TrainingPass, repeat: Callable[[], Any]) -> BadTensor | None:
    """The first tensor that is not finite while `repeat` makes a step of `objective`."""
    watch = _Watch()
    with watch.on(objective):
        repeat()
    return watch.first


class _Watch:
    """Notes the first tensor that is not finite, in the order in which a step computes."""

    def __init__(self) -> None:
        self.first: BadTensor | None = None
        self._batch = -1
        self._calls: Counter[str] = Counter()

    @contextmanager
    def on(self, objective: TrainingPass) -> Iterator[None]:
        for name, tensor in unique_tensors(objective).items():
            self._see(f"weight {name}", tensor)
        handles = [objective.register_forward_pre_hook(self._see_batch)]
        for name, module in objective.named_modules():
            # The renderer runs on detached copies: the objective's own hook shows its output.
            if name.startswith("model.") and module is not objective.model.renderer:
                handles.append(module.register_forward_hook(partial(self._see_output, name)))
        for name, parameter in objective.named_parameters():
            if parameter.requires_grad:
                handles.append(parameter.register_hook(partial(self._see, f"gradient of {name}")))
        before, objective.hook = objective.hook, self._see
        try:
            yield
        finally:
            objective.hook = before
            for handle in handles:
                handle.remove()

    def _see(self, name: str, value: Any) -> None:
        """Look at `value`: a tensor, or any nest of mappings, sequences and containers of them."""
        for path, tensor in named_tensors(value, name):
            if not self.first and (bad := nonfinite_values(tensor)):
                self.first = BadTensor(path, bad, max(self._batch, 0))

    def _see_batch(self, module: nn.Module, arguments: tuple[Any, ...]) -> None:
        self._batch += 1
        self._calls.clear()
        for name, views in zip(("inputs", "targets"), arguments, strict=True):
            self._see(name, views)

    def _see_output(self, name: str, module: nn.Module, arguments: Any, output: Any) -> None:
        # Shared modules run several times a step; the number shows which call it was.
        self._calls[name] += 1
        call = f" (call {self._calls[name]})" if self._calls[name] > 1 else ""
        self._see(f"output{call} of {name}", output)
        for path, tensor in named_tensors(output, f"gradient of the output{call} of {name}"):
            # Gradients arrive in reverse order: the first bad one is nearest to the loss.
            if tensor.requires_grad:
                tensor.register_hook(partial(self._see, path))


def nonfinite_values(tensor: Tensor) -> str:
    """How many values of `tensor` are NaN and infinite; "" if none is."""
    tensor = tensor.detach()
    if not tensor.is_floating_point() or bool(torch.isfinite(tensor).all()):
        return ""
    nan, infinite = int(torch.isnan(tensor).sum()), int(torch.isinf(tensor).sum())
    counts = [f"{n} {word}" for n, word in ((nan, "NaN"), (infinite, "infinite")) if n]
    return f"{' and '.join(counts)} of {tensor.numel()} values"


def save_incident(
    place: Path, model: QueryGaussianModel, step: int, symptom: str, reports: Sequence[Report]
) -> None:
    """Write weights.safetensors, for `qgs.load`, and report.json to `place`."""
    save(model, place / "weights.safetensors", extra={"step": str(step - 1)})
    found = [report.as_json() for report in reports]
    text = json.dumps({"step": step, "symptom": symptom, "found": found}, indent=2)
    # Last: its presence says that the incident is complete.
    write_text(place / "report.json", text + "\n")


def save_batches(path: Path, batches: Sequence[Batch]) -> None:
    """Write the batches of a step, one after the other, as a safetensors file.

    inputs.images, inputs.cameras.c2w and .intrinsics, inputs.masks and .depths where there are
    any, and the same of targets; FRAMES are metadata, in JSON.
    """
    parts: dict[str, list[Tensor]] = {}
    for batch in batches:
        for name, tensor in named_tensors({"inputs": batch.inputs, "targets": batch.targets}):
            parts.setdefault(name, []).append(tensor)
    shown = {name: json.dumps([i for b in batches for i in getattr(b, name)]) for name in FRAMES}
    write_tensors(path, {name: torch.cat(tensors) for name, tensors in parts.items()}, shown)
