"""What an attention component tells about itself is what it does."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from qgs.contracts import AttentionWeights
from qgs.testing.case import Case
from qgs.testing.faults import expect
from qgs.testing.registry import check
from qgs.testing.subjects import Inputs, inputs_of
from qgs.testing.trees import described, mapped

CLOSE = 1e-3
"""How far weights, or logarithms of them, may be from those that are recomputed, in float32."""

NEGLIGIBLE = 1e-6
"""Weights below which a token counts for hidden from a query."""

UNLIKE = "the weights change otherwise than the forward pass, in their logarithms by up to"


@check({"cross_attention", "self_attention"})
def check_explanation_is_a_softmax(case: Case) -> None:
    """The weights that `explain` tells are the softmax of content and geometry."""
    module, inputs = case.lively(), inputs_of(case)
    told = _explained(module, inputs)
    if told is None:
        return
    logits = told.content if told.geometry is None else told.content + told.geometry
    weights = logits.softmax(-1)
    shape = described(told.weights)
    expect(told.weights.shape == weights.shape, f"weights are {shape}, logits {described(logits)}")
    off = (told.weights - weights).abs().max().item()
    expect(off < CLOSE, f"weights are off the softmax of content and geometry by up to {off:.3g}")


@check({"cross_attention"})
def check_explanation_is_of_the_forward_pass(case: Case) -> None:
    """The weights that `explain` tells are those by which a forward pass reads the values.

    The gradient of a query's update in the value of a token is the weight, times what all tokens
    share, times what all queries share where values are rescaled. So from one query to the next,
    the lengths of these gradients change as the weights do, but for a factor. Where no geometry is
    told, queries of equal features look at the same.
    """
    module, inputs = case.lively(), inputs_of(case)
    told = _explained(module, inputs)
    if told is None or "memory.values" not in case.component.requires(case.config):
        return
    if told.geometry is None:
        state = inputs["state"]
        alike = state.features[:, :1].expand_as(state.features).contiguous()
        inputs["state"] = state.replace(alike)
        told = _explained(module, inputs) or told
    followed = mapped(inputs, lambda n, x: x.requires_grad_() if n == "memory.values" else x)
    update = module(*followed.values())
    values = followed["memory"].values
    lengths = [_lengths(update[:, query], values) for query in range(update.shape[1])]
    for query, (one, other) in enumerate(pairwise(lengths)):
        pair = told.weights[:, :, query], told.weights[:, :, query + 1]
        if not (one.any() and other.any()):
            continue  # it reads no values, as another check tells
        seen = torch.where(torch.minimum(*pair) > NEGLIGIBLE, _change(one, other), torch.nan)
        off = _spread(seen - _change(*pair))
        expect(off < CLOSE, f"between queries {query} and {query + 1} {UNLIKE} {off:.3g}")


def _lengths(update: Tensor, values: Tensor) -> Tensor:
    """(B, h, M) of the gradients of a query's `update` (B, D) in `values` (B, h, M, d)."""
    direction = torch.randn(update.shape, generator=torch.Generator().manual_seed(0))
    (slopes,) = torch.autograd.grad(update, values, direction.to(update), retain_graph=True)
    return slopes.norm(dim=-1)


def _change(one: Tensor, other: Tensor) -> Tensor:
    return other.log() - one.log()


def _spread(changes: Tensor) -> float:
    """By how much (B, h, M) differ over tokens, NaN ones left out."""
    known = ~changes.isnan()
    high = changes.where(known, -torch.inf).amax(-1)
    low = changes.where(known, torch.inf).amin(-1)
    return (high - low).where(known.any(-1), 0.0).max().item()


def _explained(module: Any, inputs: Inputs) -> AttentionWeights | None:
    """Attention of all queries, None for a component that does not tell."""
    queries = torch.arange(inputs["state"].features.shape[1])
    with torch.no_grad():
        return module.explain(*inputs.values(), queries)
