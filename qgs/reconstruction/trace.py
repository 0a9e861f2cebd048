"""Recording of query states and attention while a model runs, for chosen layers and queries.

with qgs.trace(model, layers=[1, 4], queries=[3, 17]) as trace:
    prediction = model(views)
trace.layers[4].cross_attention.weights         # (scenes, heads, chosen queries, image tokens)
"""

from collections.abc import Collection, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import nn

from qgs.containers import TensorContainer, map_tensors
from qgs.contracts import AttentionWeights
from qgs.model import QueryGaussianModel
from qgs.types import ImageMemory, QueryState


@dataclass
class LayerTrace(TensorContainer):
    """Record of one layer, for the Q chosen queries of B scenes.

    before, after: states (B, Q, ...) before the layer and after its refinement.
    cross_attention, self_attention: attention weights; None if the layer has no such sublayer, or
        if the sublayer's `explain` returns None.
    """

    before: QueryState
    after: QueryState | None = None
    cross_attention: AttentionWeights | None = None
    self_attention: AttentionWeights | None = None


class Trace:
    """Record of a model's last forward pass.

    queries: indices (Q,) of the recorded queries. layers: records by number; 1 is the first layer.
    grid: numbers of views, rows and columns of image tokens; None if tokens are not patches.
    """

    def __init__(self, wanted: Sequence[int], queries: Sequence[int] | None) -> None:
        self.queries = torch.tensor([], dtype=torch.long)
        self.grid: tuple[int, int, int] | None = None
        self.layers: dict[int, LayerTrace] = {}
        self._wanted = wanted
        self._wanted_queries = queries
        # Number of the layer that runs.
        self._current = 0

    def _start(self, module: nn.Module, args: Any) -> None:
        """Delete the record of the previous pass when the model starts."""
        self.layers.clear()
        self._current = 0

    def _enter(self, module: nn.Module, args: tuple[QueryState, ImageMemory]) -> None:
        """Record the state before a layer when the layer starts."""
        state, memory = args
        self._current += 1
        self.grid = memory.grid
        # Some queries are known only now, such as those that a model makes of the photos.
        if self._current == 1:
            found = _checked(self._wanted_queries, range(state.features.shape[1]), "queries")
            self.queries = torch.tensor(found, dtype=torch.long)
        if self._current in self._wanted:
            self.layers[self._current] = LayerTrace(self._chosen(state))

    @torch.no_grad()
    def _explain(self, part: str, module: Any, args: tuple[Any, ...]) -> None:
        """Record the attention weights of the sublayer called `part` when the sublayer starts."""
        if self._current in self._wanted:
            weights = module.explain(*args, self.queries.to(args[0].features.device))
            setattr(self.layers[self._current], part, weights)

    def _leave(self, module: nn.Module, args: Any, state: QueryState) -> None:
        """Record the state after a layer when its refinement ends."""
        if self._current in self._wanted:
            self.layers[self._current].after = self._chosen(state)

    def _chosen(self, state: QueryState) -> QueryState:
        index = self.queries.to(state.features.device)
        return map_tensors(lambda tensor: tensor.detach()[:, index], state)


@contextmanager
def trace(
    model: QueryGaussianModel,
    layers: Collection[int] | None = None,
    queries: Sequence[int] | None = None,
) -> Iterator[Trace]:
    """Record states and attention weights in forward passes within the `with` block.

    layers: numbers of layers; None records all. 1 is the first layer. Feedback repeats layers,
        which then get the following numbers: if a decoder of 4 layers repeats two, the first
        repetition has layers 5 and 6.
    queries: indices of queries; None records all.
    Recorded tensors have no gradients. Raises ValueError for layers or queries that do not exist.
    """
    numbers = _checked(layers, range(1, model.depth + 1), "layers")
    if model.queries.count is not None:
        _checked(queries, range(model.queries.count), "queries")
    recorded = Trace(numbers, queries)
    with ExitStack() as hooks:
        hooks.enter_context(model.register_forward_pre_hook(recorded._start))
        for layer in model.decoder:
            hooks.enter_context(layer.register_forward_pre_hook(recorded._enter))
            for part in ("cross_attention", "self_attention"):
                if hasattr(layer, part):
                    hook = partial(recorded._explain, part)
                    hooks.enter_context(getattr(layer, part).register_forward_pre_hook(hook))
        for refinement in model.refinements:
            hooks.enter_context(refinement.register_forward_hook(recorded._leave))
        yield recorded


def _checked(wanted: Collection[int] | None, existing: range, what: str) -> list[int]:
    wanted = existing if wanted is None else wanted
    if unknown := [number for number in wanted if number not in existing]:
        last = existing.stop - 1
        raise ValueError(f"{what} {unknown} do not exist; choose from {existing.start}..{last}")
    return list(wanted)
