"""Checks that results depend on no other scene, no order of queries or views, no world frame."""

from collections.abc import Callable, Collection
from typing import Any

import torch
from torch import Tensor

from qgs.containers import map_tensors
from qgs.contracts import CrossAttention, Encoder
from qgs.geometry import transforms
from qgs.types import ImageMemory
from qgs_dev.case import Case, seeded
from qgs_dev.inputs import QUERY_INPUTS, WITH_MEMORY, Inputs, inputs_of, many, required_places
from qgs_dev.vocabulary import (
    Trial,
    difference,
    each_mode,
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

# Arguments with one entry for every view.
VIEW_INPUTS = ("views", "memory", "cameras", "rendering", "target", "inputs")

# Rigid motion of the world that is not about or along any of its axes.
POSE = (
    (0.60, -0.80, 0.00, 0.4),
    (0.48, 0.36, -0.80, -0.3),
    (0.64, 0.48, 0.60, 0.6),
    (0.00, 0.00, 0.00, 1.0),
)


def check_batch_independence(case: Case) -> None:
    """Require that results for a scene do not depend on other scenes of the batch.

    Gradients of a scene's results with respect to other scenes must be exactly zero, in evaluation
    and in training. Results must not change if the other scenes of the batch change. In evaluation,
    they must not change either if the scene is alone.
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
            # Zeros must be exact, because any dependence mixes scenes.
            leak = gradient[1:].abs().max().item()
            seen = f"in {mode}, scene 0 has a gradient of {leak:.3g} in `{name}` of other scenes"
            expect(leak == 0, seen)
        first = first_scene(trial.inputs)
        expect_same(first, first_scene(beside), f"in {mode}, beside another scene", RTOL, ATOL)
        # In training, one scene may draw other random numbers than two.
        if mode == "evaluation":
            expect_same(first, first_scene(scene(trial.inputs, 0)), "alone", RTOL, ATOL)


def check_query_permutation(case: Case) -> None:
    """Require that a permutation of the queries permutes the results in the same way.

    Fields and Gaussians are permuted with their queries. Renderings and losses must not change.
    """
    order = _shuffled(many(case).queries)

    def permuted(tree: Any) -> Any:
        # The dimension of queries, or of all their Gaussians, follows that of scenes.
        return map_tensors(lambda x: x.unflatten(1, (len(order), -1))[:, order].flatten(1, 2), tree)

    names = (*QUERY_INPUTS, "gaussians", "prediction")
    found = _difference_after(
        case, names, permuted, case.slot not in ("renderer", "losses"), part=0
    )
    expect(not found, f"with {len(order)} permuted queries, {found}")


def check_view_permutation(case: Case) -> None:
    """Require that the order of views does not matter, unless `ordered_views` is declared.

    An encoder or a cross-attention may declare `ordered_views`; then the order must matter. Tokens
    of a memory without a grid, such as learned latents, must keep their order.
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
        expect(found, "the component declares `ordered_views`, but ignores the order")
    else:
        expect(not found, f"with {len(order)} permuted views, {found}{hint}")


def _shuffled(count: int) -> list[int]:
    """Return a random permutation of `count` items that moves every item."""
    order = torch.randperm(count, generator=torch.Generator().manual_seed(0))
    # One cycle through all places moves every item; a fixed item would hide errors.
    return order.roll(-1)[order.argsort()].tolist()


def _difference_after(
    case: Case, names: Collection[str], permute: Callable[[Any], Any], outputs_too: bool, part: int
) -> str:
    """Permute the inputs `names`, and compare the outputs with those that the contract requires.

    Returns a description of the first difference, or "" if there is none. A component with two
    outputs must permute the state if `part` is 0, or the memory if `part` is 1, and no more. Any
    other component must permute its outputs if `outputs_too`; else its outputs must not change.
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
    """Require that moving Gaussians, fields and cameras by one rigid motion changes no result."""
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

    # A renderer sorts by depth and cuts at limits, so rounding has larger effects.
    rtol, atol = (1e-2, 2e-3) if case.slot == "renderer" else (1e-3, 1e-5)
    expect_same(trial(), trial(mapped(trial.inputs, moved)), "in a moved world", rtol, atol)
