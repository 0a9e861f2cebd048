"""An exponential moving average of the weights."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import torch
from torch import Tensor, nn

from qgs.engine.processes import placed_like, whole
from qgs.io.checkpoint import unique_tensors


class MovingAverage:
    """float32 copies of the weights of `model`, which `update` moves towards the present ones.

    After each optimiser step: average = decay * average + (1 - decay) * weights, from the initial
    weights on. Buffers and integers are taken as they are.
    """

    def __init__(self, model: nn.Module, decay: float) -> None:
        self._model = model
        self._decay = decay
        self._averages = {name: _copy(tensor) for name, tensor in unique_tensors(model).items()}

    @torch.no_grad()
    def update(self) -> None:
        """Take the present weights into the average."""
        for name, tensor in unique_tensors(self._model).items():
            if isinstance(tensor, nn.Parameter):
                self._averages[name].lerp_(tensor.detach().float(), 1 - self._decay)
            else:
                self._averages[name].copy_(tensor)

    @contextmanager
    def applied(self) -> Iterator[None]:
        """The model with the averaged weights, for the `with` block only."""
        tensors = unique_tensors(self._model)
        present = {name: tensor.detach().clone() for name, tensor in tensors.items()}
        _install(self._averages, tensors)
        try:
            yield
        finally:
            _install(present, tensors)

    def state(self) -> dict[str, Tensor]:
        """See `qgs.engine.state.Stateful`; named as `qgs.io.checkpoint.save` takes weights."""
        return {name: whole(tensor) for name, tensor in self._averages.items()}

    @torch.no_grad()
    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """See `qgs.engine.state.Stateful`."""
        for name, average in self._averages.items():
            average.copy_(placed_like(state[name], average))


def _copy(tensor: Tensor) -> Tensor:
    copy = tensor.detach().clone()
    return copy.float() if isinstance(tensor, nn.Parameter) else copy


@torch.no_grad()
def _install(tensors: Mapping[str, Tensor], into: Mapping[str, Tensor]) -> None:
    for name, tensor in into.items():
        tensor.copy_(tensors[name])
