"""AdamW, the one-cycle learning rate, and the moving average of the weights."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn
from torch.distributed.tensor import DTensor
from torch.optim import AdamW

from qgs.contracts import ModelComponent, TrainingConfig
from qgs.engine.distributed import placed_like, whole
from qgs.io.checkpoint import unique_tensors

WARMUP_TIME = 0.1
"""Largest part of a time budget that warm-up may take."""


class OneCycle:
    """Cosine from peak / initial_divisor to the peak, then down by final_divisor from the start.

    Warm-up ends after `warmup` optimiser steps, or after WARMUP_TIME of a time budget if that comes
    first. The descent follows the fraction of the budget that is used, the larger of steps and
    seconds; with steps alone this is torch's `OneCycleLR` with pct_start = warmup / steps.
    Raises ValueError when the warm-up fills all steps and no time budget shortens it.
    """

    def __init__(self, config: TrainingConfig) -> None:
        self.config = config
        self.peak = config.learning_rate
        self.first = config.learning_rate / config.initial_divisor
        self.last = self.first / config.final_divisor
        self._descent_starts: float | None = None
        if config.seconds is None and config.warmup >= config.steps:
            raise ValueError(
                f"training.warmup is {config.warmup}, but training.steps is {config.steps}: the "
                "learning rate would never come down; lower warmup or train for longer"
            )

    def rate(self, step: int, seconds: float) -> float:
        """Learning rate of the `step`-th optimiser step (0 is the first), `seconds` into training.

        To be called with ascending steps.
        """
        used = self._used(step, seconds)
        if self._descent_starts is None:
            warmed = self._warmed(step, seconds)
            if warmed < 1:
                return _cosine(self.first, self.peak, warmed)
            self._descent_starts = used
        left = 1 - self._descent_starts
        part = (used - self._descent_starts) / left if left > 0 else 1.0
        return _cosine(self.peak, self.last, min(part, 1.0))

    def state(self) -> dict[str, float | None]:
        """See `qgs.engine.checkpoint.Stateful`."""
        return {"descent_starts": self._descent_starts}

    def load_state(self, state: Mapping[str, Any]) -> None:
        """See `qgs.engine.checkpoint.Stateful`."""
        self._descent_starts = state["descent_starts"]

    def _warmed(self, step: int, seconds: float) -> float:
        """Fraction of the warm-up that is over; may exceed 1."""
        top = self.config.warmup - 1
        of_steps = step / top if top > 0 else 1.0
        of_seconds = seconds / (WARMUP_TIME * self.config.seconds) if self.config.seconds else 0.0
        return max(of_steps, of_seconds)

    def _used(self, step: int, seconds: float) -> float:
        of_steps = step / max(self.config.steps - 1, 1)
        of_seconds = seconds / self.config.seconds if self.config.seconds else 0.0
        return min(max(of_steps, of_seconds), 1.0)


def _cosine(start: float, end: float, part: float) -> float:
    return end + (start - end) / 2 * (1 + math.cos(math.pi * part))


def make_optimizer(module: nn.Module, config: TrainingConfig) -> AdamW:
    """AdamW over all parameters of `module` that train, in decayed and undecayed groups.

    Parameters that lie in shards and whole ones are in groups of their own, where both exist.
    """
    decayed, undecayed = parameter_groups(module)
    groups = [
        {"params": parameters, "weight_decay": decay}
        for group, decay in ((decayed, config.weight_decay), (undecayed, 0.0))
        for parameters in _by_kind(group)
    ]
    return AdamW(groups, lr=config.learning_rate, betas=config.betas, fused=True)


def _by_kind(parameters: list[nn.Parameter]) -> list[list[nn.Parameter]]:
    """Parameters in shards and whole ones apart: no kernel updates both at once."""
    kinds: dict[bool, list[nn.Parameter]] = {}
    for parameter in parameters:
        kinds.setdefault(isinstance(parameter, DTensor), []).append(parameter)
    return list(kinds.values())


def parameter_groups(module: nn.Module) -> tuple[list[nn.Parameter], list[nn.Parameter]]:
    """Parameters with and without weight decay.

    The innermost component around a parameter decides (`ModelComponent.decays`); outside of
    components all but 1-d parameters decay. A shared parameter goes by its first name.
    """
    decayed: list[nn.Parameter] = []
    undecayed: list[nn.Parameter] = []
    components = {name: m for name, m in module.named_modules() if isinstance(m, ModelComponent)}
    for name, parameter in module.named_parameters():
        if parameter.requires_grad:
            decays = _decays(name, parameter, components)
            (decayed if decays else undecayed).append(parameter)
    return decayed, undecayed


def _decays(name: str, parameter: nn.Parameter, components: dict[str, ModelComponent]) -> bool:
    owners = [prefix for prefix in components if name.startswith(f"{prefix}.") or not prefix]
    if not owners:
        return parameter.ndim != 1
    innermost = max(owners, key=len)
    inner_name = name.removeprefix(innermost).removeprefix(".")
    return components[innermost].decays(inner_name, parameter)


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
        """See `qgs.engine.checkpoint.Stateful`; named as `qgs.io.checkpoint.save` takes weights."""
        return {name: whole(tensor) for name, tensor in self._averages.items()}

    @torch.no_grad()
    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """See `qgs.engine.checkpoint.Stateful`."""
        for name, average in self._averages.items():
            average.copy_(placed_like(state[name], average))


def _copy(tensor: Tensor) -> Tensor:
    copy = tensor.detach().clone()
    return copy.float() if isinstance(tensor, nn.Parameter) else copy


@torch.no_grad()
def _install(tensors: Mapping[str, Tensor], into: Mapping[str, Tensor]) -> None:
    for name, tensor in into.items():
        tensor.copy_(tensors[name])
