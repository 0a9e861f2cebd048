"""Scenes are independent, queries and views have no order, the world frame is arbitrary."""

from collections.abc import Callable, Collection
from typing import Any

import torch
from torch import Tensor

from qgs.containers import map_tensors
from qgs.contracts import CrossAttention, Encoder
from qgs.geometry import transforms
from qgs.types import ImageMemory
from qgs_dev.case import Case
from qgs_dev.inputs import QUERY_INPUTS, WITH_MEMORY, Inputs, inputs_of, many, required_places
from qgs_dev.modules import each_mode, seeded
from qgs_dev.vocabulary import (
    Trial,
    difference,
    expect,
    expect_same,
    floating,
    gradients,
    leaves,
    mapped,
    scalar,
    scene,
)

RTOL = 1e-4
ATOL = 1e-5

# Arguments that hold something of every view.
VIEW_INPUTS = ("views", "memory", "cameras", "rendering", "photos", "target", "inputs")

# A rigid motion of the world about and along none of its axes.
POSE = (
    (0.60, -0.80, 0.00, 0.4),
    (0.48, 0.36, -0.80, -0.3),
    (0.64, 0.48, 0.60, 0.6),
    (0.00, 0.00, 0.00, 1.0),
)


def check_batch_independence(case: Case) -> None:
    """Results for a scene do not depend on any other scene, in training neither.

    Its gradient there is exactly zero; beside other scenes, or alone, it has the same numbers.
    """
    sizes = many(case)
    trial = Trial(case, sizes)
    theirs = leaves(inputs_of(case, sizes, seed=1))
    beside = mapped(trial.inputs, lambda name, x: torch.cat([x[:1], theirs[name][1:]]))

    def first_scene(inputs: Inputs) -> Any:
        with seeded(0), torch.no_grad():
            return scene(trial(inputs), 0)

    for mode in each_mode(trial.module):
        given = trial.tracked()
        total = scalar(scene(floating(trial(given)), 0))
        for name, gradient in gradients(total, given).items():
            # Exact zeros: any dependence at all mixes scenes.
            leak = gradient[1:].abs().max().item()
            seen = f"in {mode}, scene 0 has a gradient of {leak:.3g} in `{name}` of others"
            expect(leak == 0, seen)
        first = first_scene(trial.inputs)
        expect_same(first, first_scene(beside), f"in {mode}, beside another scene", RTOL, ATOL)
        # In training, one scene may draw other numbers than two.
        if mode == "evaluation":
            expect_same(first, first_scene(scene(trial.inputs, 0)), "alone", RTOL, ATOL)


def check_query_permutation(case: Case) -> None:
    """Permuting the queries, with all their fields, permutes what is computed for them.

    Renderings and losses stay as they are.
    """
    order = _shuffled(many(case).queries)

    def permuted(tree: Any) -> Any:
        # A dimension of queries, or of all their Gaussians, stands behind that of scenes.
        return map_tensors(lambda x: x.unflatten(1, (len(order), -1))[:, order].flatten(1, 2), tree)

    names = (*QUERY_INPUTS, "gaussians", "prediction")
    found = _difference_after(
        case, names, permuted, case.slot not in ("renderer", "losses"), part=0
    )
    expect(not found, f"with {len(order)} permuted queries, {found}")


def check_view_permutation(case: Case) -> None:
    """Views have no order, unless an encoder or a cross-attention declares `ordered_views`.

    Then they have one. Tokens of no grid, such as learned latents, keep their places.
    """
    order = _shuffled(many(case).views)

    def permuted(tree: Any) -> Any:
        if not isinstance(tree, ImageMemory):
            return map_tensors(lambda x: x[:, order] if x.shape[1] > 1 else x, tree)
        if tree.grid is None:
            return tree
        tokens = torch.arange(tree.features.shape[1]).unflatten(0, (len(order), -1))
        tokens = tokens[order].flatten().to(tree.features.device)
        return mapped(
            tree, lambda name, x: x.index_select(2 if name in ("keys", "values") else 1, tokens)
        )

    component = case.component
    may_declare = issubclass(component, Encoder | CrossAttention)
    hint = "; declare `ordered_views` if that is meant" if may_declare else ""
    found = _difference_after(
        case, VIEW_INPUTS, permuted, case.slot in ("encoder", "renderer"), part=1
    )
    if may_declare and component.ordered_views:
        expect(found, "`ordered_views` is declared, but the order is ignored")
    else:
        expect(not found, f"with {len(order)} permuted views, {found}{hint}")


def _shuffled(count: int) -> list[int]:
    """A permutation that leaves no item in its place."""
    order = torch.randperm(count, generator=torch.Generator().manual_seed(0)).tolist()
    # One cycle through all places: a permutation with a fixed item would hide it.
    return [order[(order.index(place) + 1) % count] for place in range(count)]


def _difference_after(
    case: Case,
    names: Collection[str],
    permute: Callable[[Any], Any],
    outputs_too: bool,
    part: int,
) -> str:
    """How outputs for inputs `names` permuted differ from permuted outputs; "" if they agree.

    outputs_too: whether they are permuted. part: of state and memory, the one that is.
    """
    trial = Trial(case, many(case))
    moved = {name: permute(x) if name in names else x for name, x in trial.inputs.items()}
    expected = trial()
    if case.slot in WITH_MEMORY:
        expected = [*expected]
        expected[part] = permute(expected[part])
    elif outputs_too:
        expected = permute(expected)
    return difference(expected, trial(moved), RTOL, ATOL)


def check_world_frame_makes_no_difference(case: Case) -> None:
    """Moving the world (Gaussians, fields and cameras alike) changes no image and no loss."""
    trial = Trial(case)
    pose = torch.tensor(POSE).to(case.device)
    places = required_places(case)
    inputs = trial.inputs
    gaussians = inputs["gaussians"] if case.slot == "renderer" else inputs["prediction"].gaussians
    of_gaussians = leaves(transforms.moved(gaussians, pose, 1.0))

    def moved(name: str, x: Tensor) -> Tensor:
        if "gaussians." in name and "fields." not in name:
            return of_gaussians[name.rpartition(".")[2]]
        if name.partition("fields.")[2] in places:
            return x @ pose[:3, :3].T + pose[:3, 3]
        return pose @ x if name.endswith("c2w") else x

    # A renderer sorts by depth and cuts at limits, where rounding shows.
    rtol, atol = (1e-2, 2e-3) if case.slot == "renderer" else (1e-3, 1e-5)
    expect_same(trial(), trial.with_changed(moved), "in a moved world", rtol, atol)
