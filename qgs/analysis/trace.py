"""Looking inside a model while it runs, for chosen layers and queries only.

with qgs.trace(model, layers=[1, 4], queries=[3, 17]) as trace:
    prediction = model(views)
trace.layers[4].cross_attention.weights         # (B, h, Q, M)
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn

from qgs.contracts import AttentionWeights, CrossAttention, SelfAttention
from qgs.model import DecoderLayer, QueryGaussianModel
from qgs.types import ImageMemory, QueryState


@dataclass
class LayerTrace:
    """What one decoder layer did to the Q chosen queries.

    before, after: states (B, Q, ...) entering the layer and leaving its refinement. Attention is
    over image tokens (cross) and over all N queries (self); None where `absent` says why.
    """

    before: QueryState
    after: QueryState | None = None
    cross_attention: AttentionWeights | None = None
    self_attention: AttentionWeights | None = None
    absent: dict[str, str] = field(default_factory=dict)


@dataclass
class Trace:
    """The last forward pass inside the `with` block.

    queries: (Q,) their indices. grid: (V, H/P, W/P) of the image tokens, once a pass has run.
    layers: layer number (1 is the first) to what it did.
    """

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

    Works through forward hooks that are removed on leaving, errors included, and through the
    contracts' `explain`; nothing is recorded with gradients.
    Raises ValueError for layers or queries that do not exist.
    """
    layers = _checked(layers, range(1, model.depth + 1), "layers")
    indices = _checked(queries, range(model.queries.count), "queries")
    record = Trace(torch.tensor(indices, dtype=torch.long))
    with ExitStack() as hooks:
        _Recorder(model, record, set(layers)).attach(hooks)
        yield record


def _checked(wanted: Collection[int] | None, existing: range, what: str) -> list[int]:
    wanted = existing if wanted is None else wanted
    unknown = [number for number in wanted if number not in existing]
    if unknown:
        raise ValueError(
            f"{what} {unknown} do not exist; this model has {what} "
            f"{existing.start}..{existing.stop - 1}"
        )
    return list(wanted)


class _Recorder:
    """The hooks of one `trace` block. Layers run in order, so refinements may share a module."""

    def __init__(self, model: QueryGaussianModel, record: Trace, layers: set[int]) -> None:
        self.model = model
        self.record = record
        self.wanted = layers
        self.current = 0

    def attach(self, stack: ExitStack) -> None:
        def hook(handle: torch.utils.hooks.RemovableHandle) -> None:
            stack.callback(handle.remove)

        hook(self.model.register_forward_pre_hook(self._start))
        for number, layer in enumerate(self.model.decoder, start=1):
            assert isinstance(layer, DecoderLayer)
            hook(layer.register_forward_pre_hook(self._entering(number)))
            if number in self.wanted:
                hook(layer.cross_attention.register_forward_pre_hook(self._cross))
                hook(layer.self_attention.register_forward_pre_hook(self._self))
        for refinement in self.model.refinements:
            hook(refinement.register_forward_hook(self._refined))

    def _start(self, module: nn.Module, args: Any) -> None:
        self.record.layers.clear()
        self.record.grid = None

    def _entering(self, number: int) -> Any:
        def enter(module: nn.Module, args: tuple[QueryState, ImageMemory]) -> None:
            state, memory = args
            self.current = number
            self.record.grid = memory.grid
            if number in self.wanted:
                self.record.layers[number] = LayerTrace(before=self._chosen(state))

        return enter

    @torch.no_grad()
    def _cross(self, module: CrossAttention, args: tuple[QueryState, ImageMemory]) -> None:
        layer = self.record.layers[self.current]
        layer.cross_attention = module.explain(*args, self._indices(args[0]))
        self._note_absence(layer, "cross_attention", module, layer.cross_attention)

    @torch.no_grad()
    def _self(self, module: SelfAttention, args: tuple[QueryState]) -> None:
        layer = self.record.layers[self.current]
        layer.self_attention = module.explain(*args, self._indices(args[0]))
        self._note_absence(layer, "self_attention", module, layer.self_attention)

    def _refined(self, module: nn.Module, args: Any, state: QueryState) -> None:
        if self.current in self.wanted:
            self.record.layers[self.current].after = self._chosen(state)

    def _chosen(self, state: QueryState) -> QueryState:
        index = self._indices(state)
        return QueryState(
            state.features.detach()[:, index],
            {name: value.detach()[:, index] for name, value in state.fields.items()},
        )

    def _indices(self, state: QueryState) -> Tensor:
        return self.record.queries.to(state.features.device)

    @staticmethod
    def _note_absence(
        layer: LayerTrace, part: str, module: nn.Module, weights: AttentionWeights | None
    ) -> None:
        if weights is None:
            layer.absent[part] = f"{type(module).__name__}.explain tells nothing (returned None)"
