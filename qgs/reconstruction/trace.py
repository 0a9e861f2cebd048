"""Recording of query states and attention while a model runs, for chosen layers and queries.

with qgs.trace(model, layers=[1, 4], queries=[3, 17]) as trace:
    prediction = model(views)
trace.layers[4].cross_attention.weights         # (scenes, heads, chosen queries, image tokens)
"""

from collections.abc import Collection, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

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


@dataclass
class Trace:
    """Record of a model's last forward pass.

    queries: indices (Q,) of the recorded queries. layers: records by number; 1 is the first layer.
    grid: numbers of views, rows and columns of image tokens; None if tokens are not patches.
    """

    queries: Tensor
    grid: tuple[int, int, int] | None = None
    layers: dict[int, LayerTrace] = field(default_factory=dict)

    def chosen(self, state: QueryState) -> QueryState:
        """Return the recorded queries of a state, without gradients."""
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
    wanted = _checked(layers, range(1, model.depth + 1), "layers")
    if model.queries.count is not None:
        _checked(queries, range(model.queries.count), "queries")
    recorded = Trace(torch.tensor([], dtype=torch.long))
    current = 0  # number of the layer that runs

    def start(module: nn.Module, args: Any) -> None:
        nonlocal current
        recorded.layers.clear()
        current = 0

    def enter(module: nn.Module, args: tuple[QueryState, ImageMemory]) -> None:
        nonlocal current
        state, memory = args
        current += 1
        recorded.grid = memory.grid
        # Some queries are known only now, such as those that a model makes of the photos.
        if current == 1:
            found = _checked(queries, range(state.features.shape[1]), "queries")
            recorded.queries = torch.tensor(found, dtype=torch.long)
        if current in wanted:
            recorded.layers[current] = LayerTrace(recorded.chosen(state))

    @torch.no_grad()
    def explain(part: str, module: Any, args: tuple[Any, ...]) -> None:
        if current in wanted:
            weights = module.explain(*args, recorded.queries.to(args[0].features.device))
            setattr(recorded.layers[current], part, weights)

    def leave(module: nn.Module, args: Any, state: QueryState) -> None:
        if current in wanted:
            recorded.layers[current].after = recorded.chosen(state)

    with ExitStack() as hooks:
        hooks.enter_context(model.register_forward_pre_hook(start))
        for layer in model.decoder:
            hooks.enter_context(layer.register_forward_pre_hook(enter))
            for part in ("cross_attention", "self_attention"):
                if hasattr(layer, part):
                    hook = partial(explain, part)
                    hooks.enter_context(getattr(layer, part).register_forward_pre_hook(hook))
        for refinement in model.refinements:
            hooks.enter_context(refinement.register_forward_hook(leave))
        yield recorded


def _checked(wanted: Collection[int] | None, existing: range, what: str) -> list[int]:
    wanted = existing if wanted is None else wanted
    if unknown := [number for number in wanted if number not in existing]:
        last = existing.stop - 1
        raise ValueError(f"{what} {unknown} do not exist; choose from {existing.start}..{last}")
    return list(wanted)
