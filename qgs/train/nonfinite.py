"""Steps that are not finite: what is bad of their numbers, and which tensor was first."""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from torch import nn

from qgs.checkpoint.model_file import unique_tensors
from qgs.containers import named_tensors
from qgs.data.samples import Batch


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
    """Describes the first tensor that is not finite, in the order in which a step computes."""

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
