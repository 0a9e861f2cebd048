"""Promises of attention alone: memos, masks and explanations."""

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from qgs.types import QueryState
from qgs_dev.case import Case
from qgs_dev.inputs import Inputs, Sizes, inputs_of
from qgs_dev.vocabulary import Trial, cast, expect, expect_same, floating, mapped, masked

# Queries of a state in which each is masked in turn.
QUERIES = 6


def check_memo_is_of_the_memory_alone(case: Case) -> None:
    """`ImageMemory.once` keeps what is made of the memory: not of the state, nor of a weight.

    A layer gives on a memory that others have read what it gives on a fresh one. What a layer's own
    weights make of the memory belongs to that layer alone, and into no memo.
    """
    first = Trial(case)
    # The first layer fills the memo that the readers below find.
    first()
    memory = first.inputs["memory"]
    state = inputs_of(case, seed=1)["state"]
    for seed, what in enumerate(("the state", "a weight")):
        reader = case.lively(seed)
        fresh = reader(state, replace(memory))
        where = f"what it keeps in the memory depends on {what}: read after another layer"
        expect_same(fresh, reader(state, memory), where)


def check_masked_queries_are_not_read(case: Case) -> None:
    """Numbers where the state's mask is False change nothing of the other queries."""
    sizes = Sizes(queries=5)
    trial = Trial(case, sizes)
    state = trial.inputs["state"]
    # The scenes have different masks: a component may take one for all.
    mask = torch.tensor([[True, False, True, True, False], [True, True, False, True, True]])
    mask = mask.to(case.device)

    def seen(state: QueryState) -> Any:
        output = trial.state_of(trial(state=replace(state, mask=mask)))
        return {name: x[mask] for name, x in floating(output).items()}

    moved = masked(state, mask, inputs_of(case, sizes, seed=1)["state"])
    where = "when masked queries change, of the others"
    expect_same(seen(state), seen(moved), where, 1e-4, 1e-5)


def check_explanation_is_a_softmax(case: Case) -> None:
    """The weights that `explain` gives are the softmax of content and geometry, of all tokens.

    Content is (B, h, Q, T), for the queries that are asked for in their order; what hides a token
    is -inf in geometry, (B, 1, Q, T) or (B, h, Q, T).
    """
    trial = Trial(case)
    given = explanation(trial.module, trial.inputs)
    if given is None:
        return
    shape = tuple(given.content.shape)
    batch, queries = trial.inputs["state"].features.shape[:2]
    tokens = trial.inputs["memory"].keys.shape[2] if "memory" in trial.inputs else shape[2]
    right = shape == (batch, shape[1], queries, tokens)
    expect(right, f"content is {shape}, not (B, h, Q, T) = ({batch}, h, {queries}, {tokens})")
    expect(given.content.isfinite().all(), "content is not finite: a mask is geometry")
    asked = [2, 0]
    some = explanation(trial.module, trial.inputs, asked)
    expect(some is not None, "asked for queries 2 and 0 alone, it gives nothing")
    where = "asked for queries 2 and 0 alone, it gives other weights"
    expect_same(some.weights, given.weights[:, :, asked], where, 1e-4, 1e-5)
    logits = given.content if given.geometry is None else given.content + given.geometry
    off = (given.weights - logits.softmax(-1)).abs().max().item()
    expect(off < 1e-3, f"weights are off the softmax of content and geometry by up to {off:.3g}")


def check_explanation_is_of_the_forward_pass(case: Case) -> None:
    """The weights that `explain` gives are those by which a forward pass reads the values.

    The gradient of a query's update in the value of a token is the weight, times what all tokens
    share, times what all queries share where values are rescaled. So from one query to the next,
    the lengths of these gradients change as the weights do, but for a factor. Where no geometry is
    given, queries of equal features look at the same.
    """
    trial = Trial(case)
    given = explanation(trial.module, trial.inputs)
    if given is None or "memory.values" not in case.reads:
        return
    _expect_read_by_weights(trial)
    if given.geometry is None:
        # Without geometry the weights are of content alone, so equal content has equal weights.
        state = trial.inputs["state"]
        equal = state.features[:, :1].expand_as(state.features).clone()
        trial.inputs["state"] = state.replace(features=equal)
        _expect_read_by_weights(trial)


def _expect_read_by_weights(trial: Trial) -> None:
    weights = explanation(trial.module, trial.inputs).weights
    inputs = mapped(trial.inputs, lambda n, x: x.requires_grad_(n == "memory.values"))
    update = trial(inputs)
    values = inputs["memory"].values
    lengths = [_lengths(update[:, query], values) for query in range(update.shape[1])]
    log_lengths = torch.stack(lengths, 2).log()
    if log_lengths.isneginf().all():
        # It reads no values, as another check says.
        return
    off = (log_lengths - weights.log()).diff(dim=2)
    # Smaller weights are no more than rounding errors.
    visible = torch.minimum(weights[:, :, 1:], weights[:, :, :-1]) > 1e-6
    # A factor that all tokens share is an offset of the logarithms: only their spread counts.
    high = off.where(visible, -torch.inf).amax(-1)
    low = off.where(visible, torch.inf).amin(-1)
    worst = (high - low).where(visible.any(-1), 0.0).max().item()
    seen = "the weights change otherwise than the forward pass from one query to the next"
    expect(worst < 1e-3, f"{seen}, in their logarithms by up to {worst:.3g}")


def _lengths(update: Tensor, values: Tensor) -> Tensor:
    """(B, h, M) of the gradients of a query's `update` (B, D) in `values` (B, h, M, d)."""
    direction = torch.randn(update.shape, generator=torch.Generator().manual_seed(0))
    total = (direction.to(update) * update).sum()
    (found,) = torch.autograd.grad(total, values, retain_graph=True, materialize_grads=True)
    return found.norm(dim=-1)


def check_updates_are_explained(case: Case) -> None:
    """Updates are what the weights that `explain` gives make of one value for each query and head.

    Whichever queries are masked, the values stay. So the updates under several masks are linear in
    unknown values, of which there are fewer: they are solved for, and must leave no rest.
    """
    module = case.lively().double()
    inputs = cast(inputs_of(case, Sizes(batch=1, queries=QUERIES)), torch.float64)
    masks = torch.ones(1 + QUERIES, QUERIES, dtype=torch.bool)
    masks[1:] ^= torch.eye(QUERIES, dtype=torch.bool)
    factors = []
    updates = []
    for mask in masks:
        state = replace(inputs["state"], mask=mask[None])
        given = explanation(module, {"state": state})
        if given is None:
            return
        weights = given.weights[0, :, mask].double()  # (h, Q, N)
        # The output layer of an attention has a bias, one more unknown.
        bias = torch.ones(weights.shape[1], 1, dtype=torch.float64)
        factors.append(torch.cat([*weights, bias], 1))
        with torch.no_grad():
            updates.append(module(state)[0, mask])
    factor = torch.cat(factors)
    update = torch.cat(updates)
    # What no values explain is the rest of the least squares.
    rest = update - factor @ torch.linalg.pinv(factor) @ update
    share = (rest.norm() / update.norm().clamp_min(1e-30)).item()
    seen = "no values, read by the weights that `explain` gives, make the updates"
    expect(share < 1e-3, f"{seen}: {share:.1%} of them is left")


def explanation(module: Any, inputs: Inputs, queries: list[int] | None = None) -> Any:
    """AttentionWeights of `queries`, by default all; None of a component that explains nothing."""
    chosen = queries or range(inputs["state"].features.shape[1])
    return module.explain(*inputs.values(), torch.tensor([*chosen]))
