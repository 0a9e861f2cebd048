"""A layer's prediction cut off from the network, so that its losses can be taken in parts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import torch
from torch import Tensor

from qgs.types import Gaussians, LayerPrediction, QueryState


class Leaves:
    """Detached copies of what a layer predicts, which sum up the gradients of several losses.

    A loss frees its graph as soon as it is added, so memory does not grow with their number;
    `attach` then leads the sums into the network, which needs one backward pass for all of them.
    """

    def __init__(self, layer: LayerPrediction, parameters: Mapping[str, Tensor]) -> None:
        """parameters: of the losses, by name: what they have gradients for besides the layer."""
        self._sources = {name: p for name, p in parameters.items() if p.requires_grad}
        self._leaves = dict(self._sources)
        self._gradients: dict[str, Tensor] = {}
        gaussians = {f.name: getattr(layer.gaussians, f.name) for f in fields(layer.gaussians)}
        self.layer = LayerPrediction(
            Gaussians(**{name: self._cut(name, source) for name, source in gaussians.items()}),
            QueryState(
                self._cut("features", layer.state.features),
                {name: self._cut(name, source) for name, source in layer.state.fields.items()},
            ),
        )

    def add(self, loss: Tensor) -> None:
        """Add the gradients of a 0-d loss of `layer`, if it has any, and free its graph."""
        if not loss.requires_grad:
            return
        with torch.autocast(loss.device.type, enabled=False):
            leaves = list(self._leaves.values())
            found = torch.autograd.grad(loss, leaves, allow_unused=True)
        for name, gradient in zip(self._leaves, found, strict=True):
            if gradient is not None:
                before = self._gradients.get(name)
                self._gradients[name] = gradient if before is None else before + gradient

    @property
    def gradients(self) -> Mapping[str, Tensor]:
        """The sums so far, of the Gaussians and of the state, without those that no loss reads."""
        return self._gradients

    def attach(self, value: Tensor) -> Tensor:
        """The 0-d `value`, with the summed gradients for its own."""
        sources = [self._sources[name] for name in self._gradients]
        return _KnownGradients.apply(value, tuple(self._gradients.values()), *sources)

    def _cut(self, name: str, source: Tensor) -> Tensor:
        if not source.requires_grad:
            return source
        self._sources[name] = source
        self._leaves[name] = source.detach().requires_grad_()
        return self._leaves[name]


class _KnownGradients(torch.autograd.Function):
    """value, gradients, sources -> value, whose gradients with respect to the sources are known."""

    @staticmethod
    def forward(ctx: Any, value: Tensor, gradients: tuple[Tensor, ...], *sources: Tensor) -> Tensor:
        ctx.save_for_backward(*gradients)
        return value.clone()

    @staticmethod
    def backward(ctx: Any, *slopes: Tensor) -> tuple[Tensor | None, ...]:
        return None, None, *(slopes[0] * gradient for gradient in ctx.saved_tensors)
