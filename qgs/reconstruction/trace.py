"""Recording of states and attention while a model runs, for chosen layers and queries.

with qgs.trace(model, layers=[1, 4], queries=[3, 17]) as trace:
    prediction = model(views)
trace.layers[4].cross_attention.weights         # (B, h, Q, M)
"""

from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import nn

from qgs.containers import TensorContainer, map_tensors
from qgs.contracts import AttentionWeights
from qgs.model import QueryGaussianModel
from qgs.types import ImageMemory, QueryState

ATTENTIONS = ("cross_attention", "self_attention")


@dataclass
class LayerTrace(TensorContainer):
    """A layer's Q queries: states (B, Q, ...) and attention."""

    before: QueryState
    after: QueryState | None = None
    cross_attention: AttentionWeights | None = None
    self_attention: AttentionWeights | None = None


class Trace:
    """The last forward pass: indices (Q,), `layers` by number from 1, grid (V, H/P, W/P).

    Filled by hooks; layers run in order, though rounds and refinements share modules.
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
        """Forget the previous pass when the model begins."""
        self.layers.clear()
        self.grid = None
        self._current = 0

    def _enter(self, module: nn.Module, args: tuple[QueryState, ImageMemory]) -> None:
        """Note a layer that begins, and the queries that it gets."""
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
        """Keep the weights of an attention that begins."""
        if self._current in self._wanted:
            weights = module.explain(*args, self.queries.to(args[0].features.device))
            setattr(self.layers[self._current], part, weights)

    def _leave(self, module: nn.Module, args: Any, state: QueryState) -> None:
        """Keep the queries of a layer, which ends with its refinement."""
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
    """Record states and attention weights of `queries` in `layers` (numbers; None: all of them).

    Rounds of feedback count on: a decoder of 4 layers that repeats two has 5 and 6 in the first.

    It uses forward hooks, removed at the end, and the contracts' `explain`; without gradients.
    Raises ValueError for layers or queries that do not exist.
    """
    numbers = _checked(layers, range(1, model.depth + 1), "layers")
    if model.queries.count is not None:
        _checked(queries, range(model.queries.count), "queries")
    recorded = Trace(numbers, queries)
    handles = [model.register_forward_pre_hook(recorded._start)]
    for layer in model.decoder:
        handles.append(layer.register_forward_pre_hook(recorded._enter))
        for part in ATTENTIONS:
            if hasattr(layer, part):
                hook = partial(recorded._explain, part)
                handles.append(getattr(layer, part).register_forward_pre_hook(hook))
    handles += [part.register_forward_hook(recorded._leave) for part in model.refinements]
    try:
        yield recorded
    finally:
        for handle in handles:
            handle.remove()


def _checked(wanted: Collection[int] | None, existing: range, what: str) -> list[int]:
    wanted = existing if wanted is None else wanted
    if unknown := [number for number in wanted if number not in existing]:
        last = existing.stop - 1
        raise ValueError(f"{what} {unknown} do not exist; there are {existing.start}..{last}")
    return list(wanted)
