"""What attention alone promises: memos, masks and explanations."""

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from qgs.contracts import (
    AttentionWeights,
)
from qgs.types import (
    QueryState,
)
from qgs_dev.case import Case, expect
from qgs_dev.inputs import Inputs, Sizes, inputs_of
from qgs_dev.registry import check
from qgs_dev.trees import (
    cast,
    difference,
    floating,
    leaves,
    mapped,
)

QUERIES = 6
"""Queries of a state in which each is masked in turn."""


@check({"cross_attention"})
def check_memo_is_of_the_memory_alone(case: Case) -> None:
    """What `ImageMemory.once` keeps is made of the memory: not of the state, nor of a weight.

    A layer gives on a memory that others have read what it gives on a fresh one. What a layer's own
    weights make of the memory belongs to that layer alone, and into no memo.
    """
    layer, next_layer = case.lively(seed=0), case.lively(seed=1)
    inputs, later = inputs_of(case), inputs_of(case, seed=1)
    memory = inputs["memory"]
    layer(inputs["state"], memory)
    for reader, what in ((layer, "the state"), (next_layer, "a weight")):
        read = reader(later["state"], memory)
        found = difference(reader(later["state"], replace(memory)), read)
        seen = f"what it keeps in the memory depends on {what}: read after another layer, {found}"
        expect(not found, seen)


@check({"layer", "self_attention"})
def check_masked_queries_are_not_read(case: Case) -> None:
    """What stands where the state's mask is False changes nothing of the other queries."""
    module, inputs = case.lively(), inputs_of(case, Sizes(queries=5))
    state = inputs["state"]
    mask = torch.tensor([[True, False, True, True, False], [True, True, False, True, True]])

    def seen(state: QueryState) -> Any:
        given = {**inputs, "state": replace(state, mask=mask.to(state.features.device))}
        output = module(*given.values())
        output = output[0] if case.slot == "layer" else output
        return {name: x[mask] for name, x in floating(output).items()}

    other = inputs_of(case, Sizes(queries=5), seed=1)["state"]
    changed = {
        name: torch.where(mask.view(*mask.shape, *[1] * (x.ndim - 2)), x, leaves(other)[name])
        for name, x in leaves(state).items()
    }
    moved = mapped(state, lambda name, x: changed[name])
    found = difference(seen(state), seen(moved), 1e-4, 1e-5)
    expect(not found, f"when masked queries change, of the others {found}")


@check({"cross_attention", "self_attention"})
def check_explanation_is_a_softmax(case: Case) -> None:
    """The weights that `explain` gives are the softmax of content and geometry, of all tokens.

    Content is (B, h, Q, T), for the queries that are asked for in their order; what hides a token
    is -inf in geometry, (B, 1, Q, T) or (B, h, Q, T).
    """
    module, inputs = case.lively(), inputs_of(case)
    given = _explanation(module, inputs)
    if given is None:
        return
    tokens = inputs["memory"].keys.shape[2] if "memory" in inputs else given.content.shape[2]
    wanted, shape = inputs["state"].features.shape[:2], tuple(given.content.shape)
    right = shape == (wanted[0], shape[1], wanted[1], tokens)
    expect(right, f"content is {shape}, not (B, h, Q, T) = ({wanted[0]}, h, {wanted[1]}, {tokens})")
    expect(bool(given.content.isfinite().all()), "content is not finite: a mask is geometry")
    with torch.no_grad():
        some = module.explain(*inputs.values(), torch.tensor([2, 0]))
    found = some and difference(some.weights, given.weights[:, :, [2, 0]], 1e-4, 1e-5)
    expect(found == "", f"asked for queries 2 and 0 alone, it gives other weights: {found}")
    logits = given.content if given.geometry is None else given.content + given.geometry
    weights = logits.softmax(-1)
    off = (given.weights - weights).abs().max().item()
    expect(off < 1e-3, f"weights are off the softmax of content and geometry by up to {off:.3g}")


@check({"cross_attention"})
def check_explanation_is_of_the_forward_pass(case: Case) -> None:
    """The weights that `explain` gives are those by which a forward pass reads the values.

    The gradient of a query's update in the value of a token is the weight, times what all tokens
    share, times what all queries share where values are rescaled. So from one query to the next,
    the lengths of these gradients change as the weights do, but for a factor. Where no geometry is
    given, queries of equal features look at the same.
    """
    module, inputs = case.lively(), inputs_of(case)
    given = _explanation(module, inputs)
    if given is None or "memory.values" not in case.component.fields_read(case.config):
        return
    _expect_read_by_weights(module, inputs, given)
    if given.geometry is None:
        state = inputs["state"]
        equal = state.features[:, :1].expand_as(state.features).clone()
        inputs["state"] = state.replace(features=equal)
        _expect_read_by_weights(module, inputs, _explanation(module, inputs) or given)


def _expect_read_by_weights(module: Any, inputs: Inputs, given: AttentionWeights) -> None:
    inputs = mapped(inputs, lambda n, x: x.requires_grad_() if n == "memory.values" else x)
    update, values = module(*inputs.values()), inputs["memory"].values
    lengths = torch.stack([_lengths(update[:, n], values) for n in range(update.shape[1])], 2)
    if not lengths.any():
        return  # it reads no values, as another check says
    off = (lengths.log() - given.weights.log()).diff(dim=2)
    weights = torch.minimum(given.weights[:, :, 1:], given.weights[:, :, :-1])
    visible = weights > 1e-6  # less is no more than a rounding error
    high = off.where(visible, -torch.inf).amax(-1)
    low = off.where(visible, torch.inf).amin(-1)
    worst = (high - low).where(visible.any(-1), 0.0).max().item()
    seen = "the weights change otherwise than the forward pass from one query to the next"
    expect(worst < 1e-3, f"{seen}, in their logarithms by up to {worst:.3g}")


@check({"self_attention"})
def check_updates_are_explained(case: Case) -> None:
    """Updates are what the weights that `explain` gives make of one value for each query and head.

    Whichever queries are masked, the values stay. So the updates under several masks are linear in
    unknown values, of which there are fewer: they are solved for, and must leave no rest.
    """
    module = case.lively().double()
    inputs = cast(inputs_of(case, Sizes(batch=1, queries=QUERIES)), torch.float64)
    masks = torch.ones(1 + QUERIES, QUERIES, dtype=torch.bool)
    masks[1:] ^= torch.eye(QUERIES, dtype=torch.bool)
    factors, updates = [], []
    for mask in masks:
        state = replace(inputs["state"], mask=mask[None])
        given = _explanation(module, {"state": state})
        if given is None:
            return
        weights = given.weights[0, :, mask].double()  # (h, Q, N)
        bias = torch.ones(weights.shape[1], 1, dtype=torch.float64)
        factors.append(torch.cat([*weights, bias], 1))
        with torch.no_grad():
            updates.append(module(state)[0, mask])
    factor, update = torch.cat(factors), torch.cat(updates)
    rest = update - factor @ torch.linalg.pinv(factor) @ update
    share = (rest.norm() / update.norm().clamp_min(1e-30)).item()
    seen = "no values, read by the weights that `explain` gives, make the updates"
    expect(share < 1e-3, f"{seen}: {share:.1%} of them is left")


def _lengths(update: Tensor, values: Tensor) -> Tensor:
    """(B, h, M) of the gradients of a query's `update` (B, D) in `values` (B, h, M, d)."""
    direction = torch.randn(update.shape, generator=torch.Generator().manual_seed(0))
    total = (direction.to(update) * update).sum()
    (found,) = torch.autograd.grad(total, values, retain_graph=True, allow_unused=True)
    return values.new_zeros(values.shape[:-1]) if found is None else found.norm(dim=-1)


def _explanation(module: Any, inputs: Inputs) -> AttentionWeights | None:
    """Attention of all queries, None for a component that does not explain itself."""
    with torch.no_grad():
        return module.explain(*inputs.values(), torch.arange(inputs["state"].features.shape[1]))
