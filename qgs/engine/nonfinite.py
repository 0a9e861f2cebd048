"""Which tensor of a training step was the first that is not finite."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from qgs.engine.objective import Objective
from qgs.engine.processes import whole
from qgs.io.checkpoint import unique_tensors


@dataclass(frozen=True)
class Finding:
    """A tensor with NaN or infinity. batch: which of the step's batches it came up in, from 0."""

    tensor: str
    values: str
    batch: int

    def __str__(self) -> str:
        return f"{self.tensor} ({self.values})"


class Watch:
    """Notes the first tensor that is not finite, in the order in which a step computes.

    That is: weights, images and cameras, outputs of the model's modules, and then, layer by layer,
    what is predicted, the renderings, the loss terms and the gradients of the Gaussians; last the
    gradients of the modules' outputs and of the parameters, backwards.
    """

    def __init__(self) -> None:
        self.first: Finding | None = None
        self._batch = -1
        self._calls: Counter[str] = Counter()

    def see(self, name: str, value: Any) -> None:
        """Look at `value`: a tensor, or any nest of mappings, sequences and containers of them."""
        if self.first:
            return
        for path, tensor in _tensors(value):
            described = described_nonfinite(tensor)
            if described:
                self.first = Finding(f"{name}{path}", described, max(self._batch, 0))
                return

    @contextmanager
    def on(self, objective: Objective) -> Iterator[None]:
        """Watch the steps that `objective` makes inside the `with` block."""
        for name, tensor in unique_tensors(objective).items():
            self.see(f"weight {name}", whole(tensor))
        handles = [objective.register_forward_pre_hook(self._see_batch)]
        for name, module in objective.named_modules():
            if name.startswith("model.") and module is not objective.model.renderer:
                hook = partial(self._see_output, name)
                handles.append(module.register_forward_hook(hook))
        for name, parameter in objective.named_parameters():
            if parameter.requires_grad:
                hook = partial(self.see, f"gradient of {name}")
                handles.append(parameter.register_hook(hook))
        observe, objective.observe = objective.observe, self.see
        try:
            yield
        finally:
            objective.observe = observe
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
        what = f"output{call} of {name}"
        self.see(what, output)
        for path, tensor in _tensors(output):
            if tensor.requires_grad:
                tensor.register_hook(partial(self.see, f"gradient of the {what}{path}"))


def described_nonfinite(tensor: Tensor) -> str:
    """How many values of `tensor` are NaN and infinite; "" if none is."""
    tensor = tensor.detach()
    if not tensor.is_floating_point() or bool(torch.isfinite(tensor).all()):
        return ""
    nan, infinite = int(torch.isnan(tensor).sum()), int(torch.isinf(tensor).sum())
    counts = [f"{n} {word}" for n, word in ((nan, "NaN"), (infinite, "infinite")) if n]
    return f"{' and '.join(counts)} of {tensor.numel()} values"


def _tensors(value: Any, path: str = "") -> Iterator[tuple[str, Tensor]]:
    """The tensors of a nest, each with its path such as `.gaussians.means`."""
    if isinstance(value, Tensor):
        yield path, value
    elif isinstance(value, Mapping):
        for key, item in value.items():
            yield from _tensors(item, f"{path}.{key}")
    elif isinstance(value, list | tuple):
        for index, item in enumerate(value):
            yield from _tensors(item, f"{path}.{index}")
    elif is_dataclass(value):
        for field in fields(value):
            if field.init:
                yield from _tensors(getattr(value, field.name), f"{path}.{field.name}")
