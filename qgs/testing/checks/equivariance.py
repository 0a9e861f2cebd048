"""Scenes are independent; queries and views have no order."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from qgs.contracts import CrossAttention, Encoder
from qgs.testing.case import Case
from qgs.testing.faults import expect
from qgs.testing.modes import each_mode
from qgs.testing.registry import MODULES, PER_QUERY, check
from qgs.testing.subjects import QUERY_INPUTS, Inputs, Sizes, inputs_of, tracked_inputs
from qgs.testing.trees import distance, floating, leaves, mapped, scalar
from qgs.types import ImageMemory

RTOL, ATOL = 1e-4, 1e-5

VIEW_INPUTS = ("views", "memory", "cameras", "rendering", "target")
"""Arguments that hold something of every view."""

TOKENS = {"keys": 2, "values": 2, "features": 1, "patch_rays": 1}
"""The dimension of an image memory's tensors that counts tokens, ordered by view."""


@check(MODULES - {"queries", "losses"})
def check_batch_independence(case: Case) -> None:
    """What is computed for a scene does not depend on any other scene, in training neither.

    Its gradient there is exactly zero, and other scenes beside it leave its numbers as they are.
    """
    module = case.lively()
    for mode in each_mode(module):
        _expect_no_gradient(module, tracked_inputs(case, inputs_of(case)), mode)
        _expect_no_influence(module, inputs_of(case), inputs_of(case, seed=1), mode)


def _expect_no_gradient(module: Any, inputs: Inputs, mode: str) -> None:
    outputs = floating(module(*inputs.values()))
    total = scalar({name: tensor[:1] for name, tensor in outputs.items()})
    if not total.requires_grad:
        return
    given = {name: x for name, x in floating(inputs).items() if x.requires_grad}
    slopes = torch.autograd.grad(total, list(given.values()), allow_unused=True)
    for name, slope in zip(given, slopes, strict=True):
        leak = 0.0 if slope is None else slope[1:].abs().max().item()
        expect(leak == 0, f"in {mode}, scene 0 has a gradient of {leak:.3g} in `{name}` of scene 1")


def _expect_no_influence(module: Any, inputs: Inputs, others: Inputs, mode: str) -> None:
    different = leaves(others)
    beside = mapped(inputs, lambda name, x: torch.cat([x[:1], different[name][1:]]))
    first, second = (_first_scene(module, given) for given in (inputs, beside))
    found = distance(first, second, RTOL, ATOL)
    expect(not found, f"in {mode}, beside another scene, {found}")


def _first_scene(module: Any, inputs: Inputs) -> Any:
    """What a module gives for scene 0, always from the same random state."""
    with torch.random.fork_rng(devices=()), torch.no_grad():
        torch.default_generator.manual_seed(0)
        return mapped(module(*inputs.values()), lambda _, x: x[:1])


@check(PER_QUERY)
def check_query_permutation(case: Case) -> None:
    """Permuting the queries, with all their fields, permutes what is computed for them."""
    module, inputs = case.lively(), inputs_of(case)
    order = torch.tensor([3, 0, 5, 1, 4, 2])

    def permuted(tree: Any) -> Any:
        return mapped(tree, lambda _, tensor: tensor[:, order])

    moved = {n: permuted(x) if n in QUERY_INPUTS else x for n, x in inputs.items()}
    expected, seen = permuted(module(*inputs.values())), module(*moved.values())
    found = distance(expected, seen, RTOL, ATOL)
    expect(not found, f"with permuted queries, {found}")


@check({"encoder", "cross_attention", "renderer", "losses"})
def check_view_permutation(case: Case) -> None:
    """Views have no order, unless the component declares `ordered_views`; then they have one."""
    module, sizes = case.lively(), Sizes(views=3)
    order, inputs = [2, 0, 1], inputs_of(case, sizes)
    moved = {n: _permuted(x, order) if n in VIEW_INPUTS else x for n, x in inputs.items()}
    expected = module(*inputs.values())
    if case.slot in ("encoder", "renderer"):
        expected = _permuted(expected, order)
    found = distance(expected, module(*moved.values()), RTOL, ATOL)
    if issubclass(case.component, Encoder | CrossAttention) and case.component.ordered_views:
        expect(bool(found), "`ordered_views` is declared, but the order of the views is ignored")
        return
    expect(not found, f"with permuted views, {found}; declare `ordered_views` if that is meant")


def _permuted(tree: Any, order: list[int]) -> Any:
    """A tree with a dimension of views behind that of scenes, or an image memory."""
    if isinstance(tree, ImageMemory):
        return mapped(tree, lambda name, tensor: _tokens_permuted(tensor, TOKENS[name], order))
    return mapped(tree, lambda _, tensor: tensor[:, order] if tensor.shape[1] else tensor)


def _tokens_permuted(tensor: Tensor, axis: int, order: list[int]) -> Tensor:
    views = tensor.unflatten(axis, (len(order), -1))
    return views.index_select(axis, torch.tensor(order, device=tensor.device)).flatten(
        axis, axis + 1
    )
