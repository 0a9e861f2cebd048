"""Scenes are independent, queries and views have no order, the world frame is arbitrary."""

from typing import Any

import torch
from torch import Tensor

from qgs.containers import map_tensors
from qgs.contracts import CrossAttention, Encoder
from qgs.geometry.harmonics import rotated
from qgs.geometry.transforms import quat_to_matrix
from qgs.types import ImageMemory
from qgs_dev.case import Case, expect
from qgs_dev.inputs import (
    QUERY_INPUTS,
    Inputs,
    inputs_of,
    is_place,
    many,
    required_fields,
    tracked_inputs,
)
from qgs_dev.modules import each_mode, seeded
from qgs_dev.registry import MODULES, PER_QUERY, WITH_MEMORY, check
from qgs_dev.trees import difference, floating, gradients, leaves, mapped, scalar

RTOL, ATOL = 1e-4, 1e-5

VIEW_INPUTS = ("views", "memory", "cameras", "rendering", "photos", "target", "inputs")
"""Arguments that hold something of every view."""

TURN = (0.8, 0.4, -0.2, 0.4)
"""A unit quaternion, w x y z, about no axis of the world."""
SHIFT = (0.4, -0.3, 0.6)


@check(MODULES - {"losses"})
def check_batch_independence(case: Case) -> None:
    """What is computed for a scene does not depend on any other scene, in training neither.

    Its gradient there is exactly zero; beside other scenes, or alone, it has the same numbers.
    """
    module, sizes = case.lively(), many(case)
    inputs, others = (inputs_of(case, sizes, seed) for seed in (0, 1))
    theirs = leaves(others)
    beside = mapped(inputs, lambda name, x: torch.cat([x[:1], theirs[name][1:]]))
    alone = map_tensors(lambda x: x[:1], inputs)
    for mode in each_mode(module):
        given = tracked_inputs(case, inputs)
        outputs = floating(module(*given.values()))
        total = scalar({name: tensor[:1] for name, tensor in outputs.items()})
        for name, gradient in gradients(total, given).items():
            leak = gradient[1:].abs().max().item()
            seen = f"in {mode}, scene 0 has a gradient of {leak:.3g} in `{name}` of others"
            expect(leak == 0, seen)
        first = _first_scene(module, inputs)
        found = difference(first, _first_scene(module, beside), RTOL, ATOL)
        expect(not found, f"in {mode}, beside another scene, {found}")
        if mode == "evaluation":  # in training, one scene may draw other numbers than two
            found = difference(first, _first_scene(module, alone), RTOL, ATOL)
            expect(not found, f"alone, {found}")


def _first_scene(module: Any, inputs: Inputs) -> Any:
    with seeded(0), torch.no_grad():
        return map_tensors(lambda x: x[:1], module(*inputs.values()))


@check(PER_QUERY | {"renderer", "losses"})
def check_query_permutation(case: Case) -> None:
    """Permuting the queries, with all their fields, permutes what is computed for them.

    Renderings and losses stay as they are.
    """
    module, sizes = case.lively(), many(case)
    inputs, order = inputs_of(case, sizes), _shuffled(sizes.queries)
    counted = (*QUERY_INPUTS, "gaussians", "prediction")
    moved = {n: _reordered(x, order) if n in counted else x for n, x in inputs.items()}
    one, other = (module(*given.values()) for given in (inputs, moved))
    expected = one
    if case.slot in WITH_MEMORY:
        expected = _reordered(one[0], order), one[1]
    elif case.slot in PER_QUERY:
        expected = _reordered(one, order)
    found = difference(expected, other, RTOL, ATOL)
    expect(not found, f"with {sizes.queries} permuted queries, {found}")


@check({"encoder", "layer", "cross_attention", "feedback", "renderer", "losses"})
def check_view_permutation(case: Case) -> None:
    """Views have no order, unless an encoder or a cross-attention declares `ordered_views`.

    Then they have one. Tokens of no grid, such as learned latents, keep their places.
    """
    module, component = case.lively(), case.component
    may_declare = issubclass(component, Encoder | CrossAttention)
    ordered = may_declare and component.ordered_views
    hint = "; declare `ordered_views` if that is meant" if may_declare else ""
    sizes = many(case)
    inputs, order = inputs_of(case, sizes), _shuffled(sizes.views)
    moved = {n: _permuted(x, order) if n in VIEW_INPUTS else x for n, x in inputs.items()}
    one, other = (module(*given.values()) for given in (inputs, moved))
    expected = one
    if case.slot in WITH_MEMORY:
        expected = one[0], _permuted(one[1], order)
    elif case.slot in ("encoder", "renderer"):
        expected = _permuted(one, order)
    found = difference(expected, other, RTOL, ATOL)
    expect(ordered or not found, f"with {sizes.views} permuted views, {found}{hint}")
    ignored = "`ordered_views` is declared, but the order is ignored"
    expect(bool(found) or not ordered, ignored)


def _shuffled(count: int) -> list[int]:
    """A permutation that leaves no item in its place."""
    order = torch.randperm(count, generator=torch.Generator().manual_seed(0)).tolist()
    return [order[(order.index(place) + 1) % count] for place in range(count)]


def _reordered(tree: Any, order: list[int]) -> Any:
    """A tree with a dimension of queries, or of all their Gaussians, behind that of scenes."""
    return map_tensors(lambda x: x.unflatten(1, (len(order), -1))[:, order].flatten(1, 2), tree)


def _permuted(tree: Any, order: list[int]) -> Any:
    """A tree with a dimension of views behind that of scenes, or an image memory."""
    if isinstance(tree, ImageMemory) and tree.grid is None:
        return tree
    if not isinstance(tree, ImageMemory):
        return map_tensors(lambda x: x[:, order] if x.shape[1] > 1 else x, tree)
    if tree.grid is None:  # tokens of no view
        return tree
    tokens = torch.arange(tree.features.shape[1]).unflatten(0, (len(order), -1))[order].flatten()

    def permuted(name: str, x: Tensor) -> Tensor:
        return x.index_select(2 if name in ("keys", "values") else 1, tokens.to(x.device))

    return mapped(tree, permuted)


@check({"renderer", "losses"})
def check_world_frame_makes_no_difference(case: Case) -> None:
    """Moving the world (Gaussians, fields and cameras alike) changes no image and no loss."""
    module, inputs = case.lively(), inputs_of(case)
    motion = torch.eye(4)
    motion[:3, :3], motion[:3, 3] = quat_to_matrix(torch.tensor(TURN)), torch.tensor(SHIFT)
    places = {name for name, spec in required_fields(case).items() if is_place(spec)}

    def moved(name: str, x: Tensor) -> Tensor:
        if name.endswith("gaussians.means") or name.partition("fields.")[2] in places:
            return x @ motion[:3, :3].T.to(x) + motion[:3, 3].to(x)
        if name.endswith("gaussians.sh"):
            return rotated(x, motion[:3, :3])
        if name.endswith("quats"):
            # Hamilton's product of quaternions w x y z: first the rotation `x`, then TURN.
            a, b, c, d = TURN
            turn = torch.tensor([[a, -b, -c, -d], [b, a, -d, c], [c, d, a, -b], [d, -c, b, a]])
            return x @ turn.T.to(x)
        return motion.to(x) @ x if name.endswith("c2w") else x

    there = module(*mapped(inputs, moved).values())
    rtol, atol = (1e-2, 2e-3) if case.slot == "renderer" else (1e-3, 1e-5)
    found = difference(module(*inputs.values()), there, rtol, atol)
    expect(not found, f"in a moved world, {found}")
