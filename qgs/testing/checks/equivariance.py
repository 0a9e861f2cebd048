"""Scenes are independent; queries and views have no order."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from qgs.contracts import CrossAttention, Encoder
from qgs.testing.case import Case
from qgs.testing.chance import drawn_from, draws
from qgs.testing.faults import expect
from qgs.testing.modes import each_mode
from qgs.testing.registry import MODULES, PER_QUERY, check
from qgs.testing.subjects import QUERY_INPUTS, Inputs, Sizes, crowd_of, inputs_of, tracked_inputs
from qgs.testing.trees import cloned, distance, floating, leaves, mapped, scalar, slopes
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
    for sizes in (Sizes(), crowd_of(case)):
        for mode in each_mode(module):
            inputs, others = (inputs_of(case, sizes, seed) for seed in (0, 1))
            _expect_no_gradient(module, tracked_inputs(case, inputs), mode)
            _expect_no_influence(module, inputs, others, mode)


def _expect_no_gradient(module: Any, inputs: Inputs, mode: str) -> None:
    outputs = floating(module(*inputs.values()))
    total = scalar({name: tensor[:1] for name, tensor in outputs.items()})
    for name, slope in slopes(total, inputs).items():
        leak = slope[1:].abs().max().item()
        expect(leak == 0, f"in {mode}, scene 0 has a gradient of {leak:.3g} in `{name}` of others")


def _expect_no_influence(module: Any, inputs: Inputs, others: Inputs, mode: str) -> None:
    different = leaves(others)
    beside = mapped(inputs, lambda name, x: torch.cat([x[:1], different[name][1:]]))
    first, second = (_first_scene(module, given) for given in (inputs, beside))
    found = distance(first, second, RTOL, ATOL)
    expect(not found, f"in {mode}, beside another scene, {found}")


def _first_scene(module: Any, inputs: Inputs) -> Any:
    """What a module gives for scene 0, always from the same random state."""
    with drawn_from(0), torch.no_grad():
        return mapped(module(*inputs.values()), lambda _, x: x[:1])


@check(PER_QUERY | {"renderer", "losses"})
def check_query_permutation(case: Case) -> None:
    """Permuting the queries, with all their fields, permutes what is computed for them.

    Renderings and losses stay as they are. In training too, unless that draws numbers.
    """
    module = case.lively()
    for sizes in (Sizes(), crowd_of(case)):
        inputs, order = inputs_of(case, sizes), _shuffled(sizes.queries)
        counted = (*QUERY_INPUTS, "gaussians", "prediction")
        moved = {n: _reordered(x, order) if n in counted else x for n, x in inputs.items()}
        for mode, one, other in _compared(module, inputs, moved):
            expected = _reordered(one, order) if case.slot in PER_QUERY else one
            found = distance(expected, other, RTOL, ATOL)
            expect(not found, f"in {mode}, with {sizes.queries} permuted queries, {found}")


@check({"encoder", "cross_attention", "renderer", "losses"})
def check_view_permutation(case: Case) -> None:
    """Views have no order, unless an encoder or a cross-attention declares `ordered_views`.

    Then they have one. In training too, unless that draws numbers.
    """
    module, component = case.lively(), case.component
    may_declare = issubclass(component, Encoder | CrossAttention)
    ordered = may_declare and component.ordered_views
    hint = "; declare `ordered_views` if that is meant" if may_declare else ""
    for sizes in (Sizes(views=3), crowd_of(case)):
        inputs, order = inputs_of(case, sizes), _shuffled(sizes.views)
        moved = {n: _permuted(x, order) if n in VIEW_INPUTS else x for n, x in inputs.items()}
        for mode, one, other in _compared(module, inputs, moved):
            expected = _permuted(one, order) if case.slot in ("encoder", "renderer") else one
            found = distance(expected, other, RTOL, ATOL)
            seen = f"in {mode}, with {sizes.views} permuted views, {found}{hint}"
            expect(ordered or not found, seen)
            ignored = f"in {mode}, `ordered_views` is declared, but the order is ignored"
            expect(bool(found) or not ordered, ignored)


def _compared(module: Any, inputs: Inputs, moved: Inputs) -> Iterator[tuple[str, Any, Any]]:
    """Each mode, and what comes of either inputs.

    Not of training that draws numbers: those for one query or view are not those for another.
    """
    for mode in each_mode(module):
        if mode == "training" and draws(module, *cloned(inputs).values()):
            continue
        with torch.no_grad():
            one, other = (module(*cloned(given).values()) for given in (inputs, moved))
        yield mode, one, other


def _shuffled(count: int) -> list[int]:
    """Every item in the place of another one."""
    order = torch.randperm(count, generator=torch.Generator().manual_seed(0)).tolist()
    return [order[(order.index(place) + 1) % count] for place in range(count)]


def _reordered(tree: Any, order: list[int]) -> Any:
    """A tree with a dimension of queries, or of all their Gaussians, behind that of scenes."""
    return mapped(tree, lambda _, x: x.unflatten(1, (len(order), -1))[:, order].flatten(1, 2))


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
