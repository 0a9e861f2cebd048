"""Steps that are not finite: what is bad of their numbers, and which tensor was first."""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

from torch import Tensor, nn

from qgs.checkpoint.model_file import unique_tensors
from qgs.containers import named_tensors
from qgs.data.samples import Batch


def not_finite(numbers: Mapping[str, float]) -> str:
    """Name what is NaN or infinite of a step: loss terms, else the gradient; "" if nothing is."""
    # PSNR is infinite for a perfect image; the gradient follows the terms.
    terms = {name: n for name, n in numbers.items() if name not in ("gradient", "psnr")}
    bad = [f"loss term {name} is {n}" for name, n in terms.items() if not math.isfinite(n)]
    if not bad and not math.isfinite(numbers["gradient"]):
        bad = [f"the gradient norm is {numbers['gradient']}"]
    return ", ".join(bad)


class BadTensor(NamedTuple):
    """A tensor with NaN or infinity. batch: which of the step's batches it came up in, from 0."""

    tensor: str
    values: str
    batch: int

    def described(self, batches: Sequence[Batch]) -> str:
        """Say in words which tensor it is, and with which samples of the step's `batches`."""
        batch = batches[self.batch]
        samples = ", ".join(
            f"scene {scene!r} (inputs {list(inputs)}, targets {list(targets)})"
            for scene, inputs, targets in zip(
                batch.scenes, batch.input_frames, batch.target_frames, strict=True
            )
        )
        return f"the first bad tensor is {self.tensor} ({self.values}), with {samples}"


def first_bad_tensor(training_pass: nn.Module, repeat: Callable[[], Any]) -> BadTensor | None:
    """Return the first tensor that is not finite while `repeat` makes a step.

    Torch's anomaly mode would name an operation, not a module; it misses infinities, and raises in
    the middle of a step for which other processes wait.
    """
    watch = _Watch()
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
