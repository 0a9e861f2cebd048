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

from qgs.containers import map_tensors
from qgs.contracts import AttentionWeights
from qgs.model import QueryGaussianModel
from qgs.types import ImageMemory, QueryState

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

    Rounds of feedback count on: a decoder of 4 layers that repeats two has 5 and 6 in the first.

    It uses forward hooks, removed at the end, and the contracts' `explain`; without gradients.
    Raises ValueError for layers or queries that do not exist.
    """
    numbers = _checked(layers, range(1, model.depth + 1), "layers")
    if model.queries.count is not None:
        _checked(queries, range(model.queries.count), "queries")
    record, current = Trace(torch.tensor([], dtype=torch.long)), 0

    def chosen(state: QueryState) -> QueryState:
        index = record.queries.to(state.features.device)
        return map_tensors(lambda tensor: tensor.detach()[:, index], state)

    def start(module: nn.Module, args: Any) -> None:
        nonlocal current
        record.layers.clear()
        record.grid, current = None, 0

    def enter(module: nn.Module, args: tuple[QueryState, ImageMemory]) -> None:
        nonlocal current  # layers run in order, though rounds and refinements share modules
        state, memory = args
        number = current = current + 1
        record.grid = memory.grid
        if number == 1:
            found = _checked(queries, range(state.features.shape[1]), "queries")
            record.queries = torch.tensor(found, dtype=torch.long)
        if number in numbers:
            lacking = [part for part in ATTENTIONS if not hasattr(module, part)]
            absent = {part: f"{type(module).__name__} has no slot `{part}`" for part in lacking}
            record.layers[number] = LayerTrace(chosen(state), absent=absent)

    @torch.no_grad()
    def explain(part: str, module: Any, args: tuple[Any, ...]) -> None:
        if current not in numbers:
            return
        weights = module.explain(*args, record.queries.to(args[0].features.device))
        setattr(record.layers[current], part, weights)
        if weights is None:
            record.layers[current].absent[part] = f"{type(module).__name__}.explain returned None"

    def leave(module: nn.Module, args: Any, state: QueryState) -> None:
        if current in numbers:
            record.layers[current].after = chosen(state)

    handles = [model.register_forward_pre_hook(start)]
    for layer in model.decoder:
        handles.append(layer.register_forward_pre_hook(enter))
        for part in ATTENTIONS:
            if hasattr(layer, part):
                hook = partial(explain, part)
                handles.append(getattr(layer, part).register_forward_pre_hook(hook))
    handles += [part.register_forward_hook(leave) for part in model.refinements]
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
