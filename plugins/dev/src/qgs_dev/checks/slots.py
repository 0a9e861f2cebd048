"""What heads, queries, supervisions, data and optimisers alone promise."""

import copy
import json
import math
from dataclasses import replace
from typing import get_args

import torch
from torch import nn

from qgs.containers import map_tensors
from qgs.contracts import (
    LearnedQueries,
    Optimizer,
    ParameterGroup,
    Split,
)
from qgs.types import GaussianAttributes
from qgs.wording import listed
from qgs_dev.case import CannotCheck, Case, expect
from qgs_dev.inputs import Sizes, inputs_of
from qgs_dev.modules import each_mode, seeded
from qgs_dev.registry import check
from qgs_dev.trees import (
    cloned,
    described,
    difference,
    not_finite,
)


@check({"head"})
def check_head_gives_gaussians(case: Case) -> None:
    """Quaternions are unit, scales positive, opacities inside (0, 1), colours inside [0, 1].

    With initial parameters too, for ordinary features. `sh` and `features` are there if the head
    provides them.
    """
    named = {name.removeprefix("gaussians.") for name in case.component.fields_written(case.config)}
    modules = [(case.build(), 1.0, "with initial parameters,")]
    modules += [(case.lively(), f, f"for features times {f:g}") for f in (0.0, 1.0, 100.0)]
    state = inputs_of(case)["state"]
    for module, factor, where in modules:
        for mode in each_mode(module):
            with seeded(0), torch.no_grad():
                out = module(state.replace(features=factor * state.features))
            given = {name for name in ("sh", "features") if getattr(out, name) is not None}
            expect(
                given == named,
                f"in {mode} it gives {given or None}, and provides {named or None}",
            )
            _expect_valid(out, factor > 1, f"in {mode}, {where}")


def _expect_valid(out: GaussianAttributes, saturated: bool, where: str) -> None:
    """saturated: whether opacities may have been rounded to 0 or 1."""
    length = out.quats.norm(dim=-1)
    unit = torch.allclose(length, torch.ones_like(length), atol=1e-4)
    expect(unit, f"{where} quaternions are {length.min():.4g} to {length.max():.4g} long")
    expect(bool((out.scales > 0).all()), f"{where} a scale is {out.scales.min():.4g}")
    for name, x, ends in (("opacities", out.opacities, saturated), ("colours", out.colors, True)):
        low, high = x.min().item(), x.max().item()
        inside = (low >= 0 and high <= 1) if ends else (low > 0 and high < 1)
        inside |= name == "colours" and out.sh is not None  # degree 0 of what is clamped later
        expect(inside, f"{where} {name} are {low:.4g} to {high:.4g}")


@check({"queries"})
def check_queries_are_shared_by_scenes(case: Case) -> None:
    """Learned queries start from the same state in every scene, for any number of scenes.

    `start` gives the state that a forward pass gives.
    """
    if not issubclass(case.component, LearnedQueries):
        raise CannotCheck("these queries may read the photos: they are no LearnedQueries")
    module, inputs = case.lively(), inputs_of(case, Sizes(batch=3))
    one, several = module.start(1), module(*inputs.values())
    for scene in range(3):
        found = difference(one, map_tensors(lambda x, s=scene: x[s : s + 1], several))
        expect(not found, f"scene {scene} of 3 starts otherwise than a scene alone: {found}")


@check({"queries"})
def check_queries_resize(case: Case) -> None:
    """`resized` gives what this component loads, whatever number of queries was learned.

    Checked of components whose option `count` says how many there are.
    """
    module, options = case.build(), case.config.model_dump(mode="json")
    if "count" not in options or module.count is None:
        raise CannotCheck("no option `count` says how many queries there are")
    for count in (max(module.count // 2, 1), module.count + 3):
        text = json.dumps({**options, "count": count})
        config = type(case.config).model_validate_json(text)
        learned = dict(replace(case, config=config, state_dict=None).build(seed=1).state_dict())
        resized = module.resized(learned, torch.Generator().manual_seed(0))
        try:
            case.build(seed=2).load_state_dict(resized)
        except RuntimeError as error:
            expect(False, f"of {count} queries, `resized` gives what cannot be loaded: {error}")
        for name, values in learned.items():
            first = slice(min(len(values), len(resized[name]))) if values.ndim else ...
            kept = torch.equal(resized[name][first], values[first])
            expect(kept, f"of {count} queries, `resized` changes `{name}` of the first")


@check({"supervision"})
def check_supervision_weights(case: Case) -> None:
    """Weights are of existing layers, ascending, none negative, and sum to 1.

    So they do with ends of rounds of feedback, all of which are supervised.
    """
    ends = [case.dims.depth + 1, case.dims.depth + 2]
    longer = dict(case.build().weights(ends))
    expect(list(longer)[-2:] == ends, f"with rounds that end at {ends} it weighs {list(longer)}")
    expect(abs(sum(longer.values()) - 1) < 1e-6, f"with rounds weights sum to {longer}")
    weights = dict(case.build().weights())
    layers = list(weights)
    expect(layers == sorted(set(layers)), f"layers are {layers}")
    known = all(isinstance(n, int) and 1 <= n <= case.dims.depth for n in layers)
    expect(known and bool(layers), f"of {case.dims.depth} layers it supervises {layers}")
    expect(min(weights.values()) >= 0, f"weights are {weights}")
    expect(abs(sum(weights.values()) - 1) < 1e-6, f"weights sum to {sum(weights.values()):g}")


@check({"feedback"})
def check_feedback_compares_the_photos(case: Case) -> None:
    """`compared` views have the poses and rays of the photos, and their mean colours.

    `rounds` and what `drawn` gives are not negative, and a round repeats an existing layer.
    """
    module, photos = case.build(), inputs_of(case)["photos"]
    seen = module.compared(photos)
    found = difference(photos.cameras.c2w, seen.cameras.c2w)
    expect(not found, f"`compared` views have other poses: {found}")
    corners = [
        torch.stack([-c / f, (s - c) / f])
        for x in (photos.cameras, seen.cameras)
        for f, c, s in (
            (x.intrinsics[..., i], x.intrinsics[..., 2 + i], x.size[1 - i]) for i in (0, 1)
        )
    ]
    found = difference(corners[:2], corners[2:], 1e-5, 1e-6)
    expect(not found, f"rays through the corners of `compared` views are others: {found}")
    found = difference(photos.images.mean((-1, -2)), seen.images.mean((-1, -2)), 1e-4, 1e-5)
    expect(not found, f"mean colours of `compared` views are others: {found}")
    counts = [module.rounds, *(module.drawn() for _ in range(4))]
    expect(min(counts) >= 0, f"it makes {min(counts)} rounds")
    layers = range(0 if max(counts) == 0 else 1, case.dims.depth + 1)
    expect(module.layers in layers, f"of {case.dims.depth} layers a round repeats {module.layers}")


@check({"data"})
def check_scenes_repeat(case: Case) -> None:
    """A scene is the same each time: names, cameras, and images of the delivered size in [0, 1]."""
    first, second = (case.build().scenes("train")[0] for _ in range(2))
    expect(first.name == second.name, f"scene 0 is `{first.name}`, then `{second.name}`")
    frames = list(range(min(2, len(first))))
    images = first.images(frames)
    wanted = (len(frames), 3, *first.cameras.size)
    right = tuple(images.shape) == wanted and images.dtype == torch.float32
    expect(right, f"images are {described(images)}, not float32 of shape {wanted}")
    low, high = images.min().item(), images.max().item()
    expect(low >= 0 and high <= 1, f"images are in [{low:.3g}, {high:.3g}]")
    found = difference([first.cameras, images], [second.cameras, second.images(frames)])
    expect(not found, f"opened again, {found}")


@check({"data"})
def check_scenes_are_as_listed(case: Case) -> None:
    """`names` are those of the scenes, `groups` hold each scene once, held-out frames exist."""
    source = case.build()
    for split in get_args(Split):
        scenes, names = source.scenes(split), list(source.names(split))
        count, where = len(scenes), f"of the {split} split"
        expect(len(names) == count, f"{where}, there are {count} scenes, {len(names)} names")
        grouped = sorted(int(i) for group in source.groups(split) for i in group)
        once = grouped == list(range(count))
        expect(once, f"{where}, groups hold not each of {count} scenes once: {listed(grouped)}")
        for place in {0, count // 2, count - 1} if count else ():
            scene, name = scenes[place], f"scene {place} {where}"
            expect(scene.name == names[place], f"{name} is `{scene.name}`, not {names[place]}")
            outside = [frame for frame in scene.held_out if not 0 <= frame < len(scene)]
            expect(not outside, f"{name} has {len(scene)} frames and holds out {outside}")


@check({"optimizer"})
def check_optimizer_steps(case: Case) -> None:
    """Steps move all parameters that have gradients and no others, at finite learning rates.

    Its groups hold all parameters that it was given, with the `factor` of their learning rate.
    """
    run = _Optimization(case)
    given = [x for group in run.torch_optimizer.param_groups for x in group["params"]]
    expect({*map(id, given)} == {*map(id, run.weights)}, "it leaves out parameters, or adds some")
    lost = [group for group in run.torch_optimizer.param_groups if "factor" not in group]
    expect(not lost, "a group of its own has no `factor`, by which its learning rate is scaled")
    before = cloned(run.weights)
    run.step(range(3))
    expect(not not_finite(run.weights), "after three steps a parameter is not finite")
    still = [torch.equal(old, new) for old, new in zip(before, run.weights, strict=True)]
    expect(not any(still[:2]), "three steps leave a parameter with a gradient as it was")
    expect(still[2], "it moves a parameter that has no gradient")


@check({"optimizer"})
def check_optimizer_continues(case: Case) -> None:
    """Restored from its `state`, and from what torch's optimiser keeps of each parameter, an
    optimiser goes on as if it had not stopped, to the bit."""
    straight, first, second = _Optimization(case), _Optimization(case), _Optimization(case)
    straight.step(range(6))
    first.step(range(3))
    with torch.no_grad():
        for theirs, ours in zip(first.weights, second.weights, strict=True):
            ours.copy_(theirs)
            kept = first.torch_optimizer.state.get(theirs, {})
            second.torch_optimizer.state[ours] = copy.deepcopy(kept)
    second.optimizer.load_state(json.loads(json.dumps(dict(first.optimizer.state()))))
    second.step(range(3, 6))
    found = difference(straight.weights, second.weights)
    expect(not found, f"after six steps, or three and three from a checkpoint, {found}")


class _Optimization:
    """Three parameters and their optimiser: one decays, one does not, one gets no gradient."""

    def __init__(self, case: Case) -> None:
        generator = torch.Generator().manual_seed(0)
        self.weights = [nn.Parameter(torch.randn(4, 3, generator=generator)) for _ in range(3)]
        self.optimizer: Optimizer = case.build()
        self.torch_optimizer = self.optimizer.build(
            [
                ParameterGroup(params=self.weights[::2], decays=True, factor=1.0),
                ParameterGroup(params=self.weights[1:2], decays=False, factor=0.5),
            ]
        )

    def step(self, steps: range) -> None:
        """As training does, with other gradients in every step."""
        for step in steps:
            rate = self.optimizer.learning_rate(step, float(step))
            expect(0 <= rate < math.inf, f"the learning rate of step {step} is {rate}")
            for group in self.torch_optimizer.param_groups:
                group["lr"] = rate * group.get("factor", 1.0)
            generator = torch.Generator().manual_seed(step)
            for weights in self.weights[:2]:
                weights.grad = torch.randn(weights.shape, generator=generator)
            self.torch_optimizer.step()
