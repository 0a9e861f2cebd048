"""Looking inside a model while it runs, for chosen layers and queries only.

with qgs.trace(model, layers=[1, 4], queries=[3, 17]) as trace:
    prediction = model(views)
trace.layers[4].cross_attention.weights         # (B, h, Q, M)
"""

from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils.hooks import RemovableHandle

from qgs.contracts import AttentionWeights
from qgs.model import QueryGaussianModel
from qgs.types import ImageMemory, QueryState, map_tensors

ATTENTIONS = ("cross_attention", "self_attention")


@dataclass
class LayerTrace:
    """A layer's Q queries: states (B, Q, ...), attention, and why one is `absent`."""

    before: QueryState
    after: QueryState | None = None
    cross_attention: AttentionWeights | None = None
    self_attention: AttentionWeights | None = None
    absent: dict[str, str] = field(default_factory=dict)


@dataclass
class Trace:
    """The last forward pass: indices (Q,), `layers` by number from 1, grid (V, H/P, W/P)."""

    queries: Tensor
    grid: tuple[int, int, int] | None = None
    layers: dict[int, LayerTrace] = field(default_factory=dict)


@contextmanager
def trace(
    model: QueryGaussianModel,
    layers: Collection[int] | None = None,
    queries: Sequence[int] | None = None,
) -> Iterator[Trace]:
    """Record states and attention weights of `queries` in `layers` (numbers; None: all of them).

    It uses forward hooks, removed at the end, and the contracts' `explain`; without gradients.
    Raises ValueError for layers or queries that do not exist.
    """
    layers = _checked(layers, range(1, model.depth + 1), "layers")
    if model.queries.count is not None:
        _checked(queries, range(model.queries.count), "queries")
    record = Trace(torch.tensor([], dtype=torch.long))
    handles = [*_Recorder(record, layers, queries).hook_into(model)]
    try:
        yield record
    finally:
        for handle in handles:
            handle.remove()


def _checked(wanted: Collection[int] | None, existing: range, what: str) -> list[int]:
    wanted = existing if wanted is None else wanted
    if unknown := [number for number in wanted if number not in existing]:
        last = existing.stop - 1
        raise ValueError(f"{what} {unknown} do not exist; there are {existing.start}..{last}")
    return list(wanted)


class _Recorder:
    """The hooks of one `trace` block. Layers run in order, so refinements may share a module."""

    def __init__(
        self, record: Trace, layers: Collection[int], queries: Sequence[int] | None
    ) -> None:
        self.record, self.layers, self.queries, self.current = record, layers, queries, 0

    def hook_into(self, model: QueryGaussianModel) -> Iterator[RemovableHandle]:
        """Register the hooks."""
        yield model.register_forward_pre_hook(self._start)
        for number, layer in enumerate(model.decoder, start=1):
            yield layer.register_forward_pre_hook(partial(self._enter, number))
            if number in self.layers:
                for part in ATTENTIONS:
                    if hasattr(layer, part):
                        hook = partial(self._explain, part)
                        yield getattr(layer, part).register_forward_pre_hook(hook)
        for refinement in model.refinements:
            yield refinement.register_forward_hook(self._leave)

    def _start(self, module: nn.Module, args: Any) -> None:
        self.record.layers.clear()
        self.record.grid = None

    def _enter(self, number: int, module: nn.Module, args: tuple[QueryState, ImageMemory]) -> None:
        state, memory = args
        self.current = number
        self.record.grid = memory.grid
        if number == 1:
            chosen = _checked(self.queries, range(state.features.shape[1]), "queries")
            self.record.queries = torch.tensor(chosen, dtype=torch.long)
        if number in self.layers:
            kind = type(module).__name__
            lacking = [part for part in ATTENTIONS if not hasattr(module, part)]
            absent = {part: f"{kind} has no slot `{part}`" for part in lacking}
            self.record.layers[number] = LayerTrace(self._chosen(state), absent=absent)

    @torch.no_grad()
    def _explain(self, part: str, module: Any, args: tuple[Any, ...]) -> None:
        layer = self.record.layers[self.current]
        weights = module.explain(*args, self.record.queries.to(args[0].features.device))
        setattr(layer, part, weights)
        if weights is None:
            layer.absent[part] = f"{type(module).__name__}.explain returned None"

    def _leave(self, module: nn.Module, args: Any, state: QueryState) -> None:
        if self.current in self.layers:
            self.record.layers[self.current].after = self._chosen(state)

    def _chosen(self, state: QueryState) -> QueryState:
        index = self.record.queries.to(state.features.device)
        return map_tensors(lambda tensor: tensor.detach()[:, index], state)
