"""Checks of heads, queries, supervisions, feedback, data and optimisers."""

import copy
import json
import math
from collections.abc import Iterable
from typing import get_args

import torch
from torch import nn

from qgs.contracts import LearnedQueries, Optimizer, ParameterGroup, Split
from qgs.wording import listed
from qgs_dev.case import CannotCheck, Case
from qgs_dev.inputs import Sizes
from qgs_dev.vocabulary import (
    Trial,
    cloned,
    described,
    expect,
    expect_finite,
    expect_inside,
    expect_same,
    leaves,
    scene,
)


def check_head_gives_gaussians(case: Case) -> None:
    """Require unit quaternions, positive scales, opacities in (0, 1) and colours in [0, 1].

    The check runs with initial and with perturbed parameters. Gaussians must have `sh` and
    `features` if the head provides them, and must not have them otherwise.
    """
    trial = Trial(case)
    for factor in (0.0, 1.0, 100.0):
        _expect_gaussians(trial, factor, f"for features times {factor:g}")
    trial.module = case.build()
    _expect_gaussians(trial, 1.0, "with initial parameters")


def _expect_gaussians(trial: Trial, factor: float, where: str) -> None:
    state = trial.inputs["state"]
    state = state.replace(features=factor * state.features)
    named = {name.removeprefix("gaussians.") for name in trial.case.writes}
    for mode, out in trial.in_each_mode({"state": state}):
        here = f"in {mode}, {where},"
        given = {"sh", "features"} & leaves(out).keys()
        expect(given == named, f"in {mode} the head gives {given or None}, not {named or None}")
        expect_inside(out.quats.norm(dim=-1), 1 - 1e-4, 1 + 1e-4, f"{here} lengths of quaternions")
        expect((out.scales > 0).all(), f"{here} a scale is {out.scales.min():.4g}")
        expect_inside(out.opacities, 0, 1, f"{here} opacities")
        # Opacities of large features may round to 0 or 1.
        ends = (out.opacities == 0) | (out.opacities == 1)
        expect(factor > 1 or not ends.any(), f"{here} an opacity is 0 or 1")
        # With `sh`, colours are the degree 0 of a sum that is clamped later.
        if out.sh is None:
            expect_inside(out.colors, 0, 1, f"{here} colours")


def check_queries_are_shared_by_scenes(case: Case) -> None:
    """Require that learned queries start from the same state in every scene.

    The method `start`, called for one scene, must return the state that a forward pass gives each
    scene of a batch.
    """
    if not issubclass(case.component, LearnedQueries):
        raise CannotCheck("these queries are not LearnedQueries, so they may read the photos")
    trial = Trial(case, Sizes(batch=3))
    one = trial.module.start(1)
    several = trial()
    for index in range(3):
        where = f"scene {index} of 3 starts from another state than a scene alone"
        expect_same(one, scene(several, index), where)


def check_queries_resize(case: Case) -> None:
    """Require that `resized` adapts a state dict with more or fewer queries to this component.

    Queries that exist in both must keep their values. The check applies to components whose option
    `count` is the number of queries.
    """
    module = case.build()
    if not hasattr(case.config, "count") or module.count is None:
        raise CannotCheck("the component has no option `count` for the number of queries")
    # Fewer queries must be filled up, more queries must be cut.
    for count in (max(module.count // 2, 1), module.count + 3):
        config = case.config.model_copy(update={"count": count})
        # another seed than that of `module`, whose own values must not pass for kept ones
        learned = dict(case.with_config(config).build(seed=1).state_dict())
        resized = module.resized(learned, torch.Generator().manual_seed(0))
        try:
            case.build(seed=2).load_state_dict(resized)
        except RuntimeError as error:
            expect(False, f"`resized` of {count} queries cannot be loaded: {error}")
        for name, values in learned.items():
            # a value without axes has no queries to compare
            first = slice(min(len(values), len(resized[name]))) if values.ndim else ...
            kept = torch.equal(resized[name][first], values[first])
            expect(kept, f"`resized` of {count} queries changes `{name}` of the kept queries")


def check_supervision_weights(case: Case) -> None:
    """Require that supervision weights are non-negative, sum to 1 and belong to existing layers.

    Layers must be in ascending order. With rounds of feedback, the last layer of every round must
    have a weight.
    """
    depth = case.dims.depth
    for rounds in ([], [depth + 1, depth + 2]):
        weights = dict(case.build().weights(rounds))
        where = f"with {depth} layers and rounds that end at {rounds},"
        chosen = [layer for layer in [*range(1, depth + 1), *rounds] if layer in weights]
        right = weights and [*weights] == chosen and weights.keys() >= {*rounds}
        expect(right, f"{where} the component supervises {[*weights]}")
        expect(min(weights.values()) >= 0, f"{where} weights are {weights}")
        total = sum(weights.values())
        expect(abs(total - 1) < 1e-6, f"{where} weights sum to {total:g}")


def check_feedback_repeats_layers(case: Case) -> None:
    """Require that rounds of feedback repeat layers that exist, in training and in evaluation.

    The number of rounds must not be negative. Results in `torch.inference_mode` must be those of a
    pass with gradients.
    """
    trial = Trial(case)
    module = trial.module
    # Training draws the number of rounds.
    counts = [module.rounds, *(module.drawn() for _ in range(4))]
    expect(min(counts) >= 0, f"the component makes {min(counts)} rounds")
    layers = range(bool(max(counts)), case.dims.depth + 1)
    expect(
        module.layers in layers,
        f"a round repeats {module.layers} layers of a decoder with {case.dims.depth}",
    )
    with torch.inference_mode():
        outputs = trial()
    expect_same(trial(), outputs, "in `torch.inference_mode`")


def check_scenes_repeat(case: Case) -> None:
    """Require that a scene has the same name, cameras and images each time the data are opened.

    Images must be float32, of the cameras' size, with values in [0, 1].
    """
    first, second = (case.build().scenes("train")[0] for _ in range(2))
    expect(first.name == second.name, f"scene 0 is first `{first.name}`, then `{second.name}`")
    frames = list(range(min(2, len(first))))
    images = first.images(frames)
    wanted = (len(frames), 3, *first.cameras.size)
    right = images.shape == wanted and images.dtype == torch.float32
    expect(right, f"images are {described(images)}, not float32 of shape {wanted}")
    expect_inside(images, 0, 1, "images")
    again = [second.cameras, second.images(frames)]
    expect_same([first.cameras, images], again, "opened a second time, scene 0 differs")


def check_scenes_are_as_listed(case: Case) -> None:
    """Require that `names`, `groups` and held-out frames agree with the scenes of a split.

    `names` must list the names of all scenes, `groups` must hold each scene once, and held-out
    frames must exist.
    """
    source = case.build()
    for split in get_args(Split):
        where = f"in the {split} split"
        scenes = source.scenes(split)
        count = len(scenes)
        names = list(source.names(split))
        expect(len(names) == count, f"{where} there are {count} scenes, but {len(names)} names")
        grouped = sorted(int(index) for group in source.groups(split) for index in group)
        once = grouped == list(range(count))
        expect(once, f"{where} groups do not hold each of {count} scenes once: {listed(grouped)}")
        # Only the ends and the middle, since a data set may have millions of scenes.
        for place in {0, count // 2, count - 1} if count else ():
            found = scenes[place]
            name = f"scene {place} {where}"
            expect(found.name == names[place], f"{name} is `{found.name}`, not {names[place]}")
            outside = [frame for frame in found.held_out if not 0 <= frame < len(found)]
            expect(not outside, f"{name} has {len(found)} frames and holds out {outside}")


def check_optimizer_steps(case: Case) -> None:
    """Require that optimiser steps change all parameters with a gradient, and no others.

    Learning rates must be finite. Parameter groups must hold all given parameters, and must have
    the key `factor`, by which the learning rate is multiplied.
    """
    run = _Optimization(case)
    groups = run.torch_optimizer.param_groups
    given = {id(parameter) for group in groups for parameter in group["params"]}
    expect(given == {*map(id, run.weights)}, "the groups do not hold exactly the given parameters")
    factors = all("factor" in group for group in groups)
    expect(factors, "a group has no `factor`, which scales its learning rate")
    before = cloned(run.weights)
    run.step(range(3))
    expect_finite(run.weights, "after three steps")
    decaying, other, without_gradient = (
        torch.equal(old, new) for old, new in zip(before, run.weights, strict=True)
    )
    expect(not (decaying or other), "three steps do not change a parameter that has a gradient")
    expect(without_gradient, "three steps change a parameter that has no gradient")


def check_optimizer_continues(case: Case) -> None:
    """Require bitwise equal results when training continues from a restored optimiser state.

    The state consists of the optimiser's `state` and of the values that torch's optimiser keeps for
    each parameter.
    """
    straight, first, second = (_Optimization(case) for _ in range(3))
    straight.step(range(6))
    first.step(range(3))
    for theirs, ours in zip(first.weights, second.weights, strict=True):
        ours.data.copy_(theirs)
        kept = first.torch_optimizer.state.get(theirs, {})
        second.torch_optimizer.state[ours] = copy.deepcopy(kept)
    # A checkpoint stores these numbers as JSON.
    second.optimizer.load_state(json.loads(json.dumps(dict(first.optimizer.state()))))
    second.step(range(3, 6))
    where = "six steps differ from three steps, a checkpoint and three more"
    expect_same(straight.weights, second.weights, where)


class _Optimization:
    """Optimiser of three parameters: one with weight decay, one without, one without a gradient."""

    def __init__(self, case: Case) -> None:
        generator = torch.Generator().manual_seed(0)
        self.weights = [nn.Parameter(torch.randn(4, 3, generator=generator)) for _ in range(3)]
        self.optimizer: Optimizer = case.build()
        decaying, other, without_gradient = self.weights
        self.torch_optimizer = self.optimizer.build(
            [
                ParameterGroup(params=[decaying, without_gradient], decays=True, factor=1.0),
                ParameterGroup(params=[other], decays=False, factor=0.5),
            ]
        )

    def step(self, steps: Iterable[int]) -> None:
        """Take optimiser steps as training does, with random gradients for each step."""
        for step in steps:
            rate = self.optimizer.learning_rate(step, float(step))
            expect(0 <= rate < math.inf, f"the learning rate of step {step} is {rate}")
            # Training sets the rate of every group before each step.
            for group in self.torch_optimizer.param_groups:
                group["lr"] = rate * group.get("factor", 1.0)
            generator = torch.Generator().manual_seed(step)
            # The third parameter gets no gradient.
            for weights in self.weights[:2]:
                weights.grad = torch.randn(weights.shape, generator=generator)
            self.torch_optimizer.step()
