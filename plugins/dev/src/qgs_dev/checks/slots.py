"""Promises of heads, queries, supervisions, data and optimisers alone."""

import copy
import json
import math
from collections.abc import Iterable
from typing import get_args

import torch
from torch import Tensor, nn

from qgs.contracts import LearnedQueries, Optimizer, ParameterGroup, Split
from qgs.types import Cameras
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
    scene,
)


def check_head_gives_gaussians(case: Case) -> None:
    """Quaternions are unit, scales positive, opacities inside (0, 1), colours inside [0, 1].

    With initial parameters too, for ordinary features. `sh` and `features` are there if the head
    provides them.
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
        given = {name for name in ("sh", "features") if getattr(out, name) is not None}
        expect(given == named, f"in {mode} it gives {given or None}, and provides {named or None}")
        expect_inside(out.quats.norm(dim=-1), 1 - 1e-4, 1 + 1e-4, f"{here} lengths of quaternions")
        expect((out.scales > 0).all(), f"{here} a scale is {out.scales.min():.4g}")
        expect_inside(out.opacities, 0, 1, f"{here} opacities")
        # Opacities of large features may have been rounded to 0 or 1.
        ends = (out.opacities == 0) | (out.opacities == 1)
        expect(factor > 1 or not ends.any(), f"{here} an opacity is 0 or 1")
        # With `sh` they are degree 0 of what is clamped later.
        if out.sh is None:
            expect_inside(out.colors, 0, 1, f"{here} colours")


def check_queries_are_shared_by_scenes(case: Case) -> None:
    """Learned queries start from the same state in every scene, for any number of scenes.

    `start` gives the state that a forward pass gives.
    """
    if not issubclass(case.component, LearnedQueries):
        raise CannotCheck("these queries may read the photos: they are no LearnedQueries")
    trial = Trial(case, Sizes(batch=3))
    one = trial.module.start(1)
    several = trial()
    for index in range(3):
        where = f"scene {index} of 3 starts otherwise than a scene alone"
        expect_same(one, scene(several, index), where)


def check_queries_resize(case: Case) -> None:
    """`resized` gives what this component loads, whatever number of queries was learned.

    Checked of components whose option `count` says how many there are.
    """
    module = case.build()
    options = case.config.model_dump(mode="json")
    if "count" not in options or module.count is None:
        raise CannotCheck("no option `count` says how many queries there are")
    # Fewer and more queries than there are: cut and filled up.
    for count in (max(module.count // 2, 1), module.count + 3):
        options["count"] = count
        config = type(case.config).model_validate_json(json.dumps(options))
        learned = dict(case.with_config(config).build(seed=1).state_dict())
        resized = module.resized(learned, torch.Generator().manual_seed(0))
        try:
            case.build(seed=2).load_state_dict(resized)
        except RuntimeError as error:
            expect(False, f"of {count} queries, `resized` gives what cannot be loaded: {error}")
        for name, values in learned.items():
            first = slice(min(len(values), len(resized[name]))) if values.ndim else ...
            kept = torch.equal(resized[name][first], values[first])
            expect(kept, f"of {count} queries, `resized` changes `{name}` of the first")


def check_supervision_weights(case: Case) -> None:
    """Weights are of existing layers, ascending, none negative, and sum to 1.

    So they do with ends of rounds of feedback, all of which are supervised.
    """
    depth = case.dims.depth
    for rounds in ([], [depth + 1, depth + 2]):
        weights = dict(case.build().weights(rounds))
        where = f"of {depth} layers, with rounds that end at {rounds},"
        chosen = [layer for layer in [*range(1, depth + 1), *rounds] if layer in weights]
        right = weights and [*weights] == chosen and weights.keys() >= {*rounds}
        expect(right, f"{where} it supervises {[*weights]}")
        expect(min(weights.values()) >= 0, f"{where} weights are {weights}")
        total = sum(weights.values())
        expect(abs(total - 1) < 1e-6, f"{where} weights sum to {total:g}")


def check_feedback_compares_the_photos(case: Case) -> None:
    """`compared` views have the poses and rays of the photos, and their mean colours.

    `rounds` and what `drawn` gives are not negative, and a round repeats an existing layer.
    """
    trial = Trial(case)
    module = trial.module
    photos = trial.inputs["photos"]
    seen = module.compared(photos)
    expect_same(photos.cameras.c2w, seen.cameras.c2w, "`compared` views have other poses")
    corners, of_seen = (_corners(views.cameras) for views in (photos, seen))
    expect_same(
        corners, of_seen, "rays through the corners of `compared` views are others", 1e-5, 1e-6
    )
    colours, of_seen = (views.images.mean((-1, -2)) for views in (photos, seen))
    expect_same(colours, of_seen, "`compared` views have other mean colours", 1e-4, 1e-5)
    # Training draws the number of rounds.
    counts = [module.rounds, *(module.drawn() for _ in range(4))]
    expect(min(counts) >= 0, f"it makes {min(counts)} rounds")
    layers = range(bool(max(counts)), case.dims.depth + 1)
    expect(module.layers in layers, f"of {case.dims.depth} layers a round repeats {module.layers}")


def _corners(cameras: Cameras) -> Tensor:
    """Rays through the first and last pixel's corner, (..., 4): x / z and y / z of both."""
    focal = cameras.intrinsics[..., :2]
    principal = cameras.intrinsics[..., 2:]
    size = torch.tensor(cameras.size[::-1]).to(focal)
    return torch.cat([-principal / focal, (size - principal) / focal], -1)


def check_scenes_repeat(case: Case) -> None:
    """A scene is the same each time: names, cameras, and images of the delivered size in [0, 1]."""
    first, second = (case.build().scenes("train")[0] for _ in range(2))
    expect(first.name == second.name, f"scene 0 is `{first.name}`, then `{second.name}`")
    frames = list(range(min(2, len(first))))
    images = first.images(frames)
    wanted = (len(frames), 3, *first.cameras.size)
    right = images.shape == wanted and images.dtype == torch.float32
    expect(right, f"images are {described(images)}, not float32 of shape {wanted}")
    expect_inside(images, 0, 1, "images")
    again = [second.cameras, second.images(frames)]
    expect_same([first.cameras, images], again, "opened again")


def check_scenes_are_as_listed(case: Case) -> None:
    """`names` are those of the scenes, `groups` hold each scene once, held-out frames exist."""
    source = case.build()
    for split in get_args(Split):
        where = f"of the {split} split"
        scenes = source.scenes(split)
        count = len(scenes)
        names = list(source.names(split))
        expect(len(names) == count, f"{where}, there are {count} scenes, {len(names)} names")
        grouped = sorted(int(index) for group in source.groups(split) for index in group)
        once = grouped == list(range(count))
        expect(once, f"{where}, groups hold not each of {count} scenes once: {listed(grouped)}")
        # The ends and the middle: a data set may have millions of scenes.
        for place in {0, count // 2, count - 1} if count else ():
            found = scenes[place]
            name = f"scene {place} {where}"
            expect(found.name == names[place], f"{name} is `{found.name}`, not {names[place]}")
            outside = [frame for frame in found.held_out if not 0 <= frame < len(found)]
            expect(not outside, f"{name} has {len(found)} frames and holds out {outside}")


def check_optimizer_steps(case: Case) -> None:
    """Steps move all parameters that have gradients and no others, at finite learning rates.

    Its groups hold all parameters that it was given, with the `factor` of their learning rate.
    """
    run = _Optimization(case)
    groups = run.torch_optimizer.param_groups
    given = {id(parameter) for group in groups for parameter in group["params"]}
    expect(given == {*map(id, run.weights)}, "it leaves out parameters, or adds some")
    factors = all("factor" in group for group in groups)
    expect(factors, "a group of its own has no `factor`, by which its learning rate is scaled")
    before = cloned(run.weights)
    run.step(range(3))
    expect_finite(run.weights, "after three steps")
    decaying, other, without_gradient = (
        torch.equal(old, new) for old, new in zip(before, run.weights, strict=True)
    )
    expect(not (decaying or other), "three steps leave a parameter with a gradient as it was")
    expect(without_gradient, "it moves a parameter that has no gradient")


def check_optimizer_continues(case: Case) -> None:
    """Restored from its `state`, and from what torch's optimiser keeps of each parameter, an
    optimiser goes on as if it had not stopped, to the bit."""
    straight, first, second = (_Optimization(case) for _ in range(3))
    straight.step(range(6))
    first.step(range(3))
    for theirs, ours in zip(first.weights, second.weights, strict=True):
        ours.data.copy_(theirs)
        kept = first.torch_optimizer.state.get(theirs, {})
        second.torch_optimizer.state[ours] = copy.deepcopy(kept)
    # As in a checkpoint, whose numbers are JSON.
    second.optimizer.load_state(json.loads(json.dumps(dict(first.optimizer.state()))))
    second.step(range(3, 6))
    where = "after six steps, or three and three from a checkpoint"
    expect_same(straight.weights, second.weights, where)


class _Optimization:
    """Three parameters and their optimiser: one decays, one does not, one gets no gradient."""

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
        """Step as training does, with other gradients in every step."""
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
