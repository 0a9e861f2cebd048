"""What components of one slot alone promise; for renderers, see `rendering`."""

import copy
import json
import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, get_args

import torch
from torch import Tensor, nn

from qgs.contracts import (
    AttentionWeights,
    Encoder,
    LearnedQueries,
    Loss,
    Metric,
    MetricInput,
    Optimizer,
    ParameterGroup,
    Queries,
    Split,
)
from qgs.geometry.rays import patch_rays, plucker_rays
from qgs.types import (
    GaussianAttributes,
    ImageMemory,
    LayerPrediction,
    Photos,
    QueryState,
    Views,
    map_tensors,
)
from qgs.wording import listed
from qgs_plugintools.case import CannotCheck, Case, expect
from qgs_plugintools.inputs import Inputs, Maker, Sizes, inputs_of
from qgs_plugintools.modules import each_mode, seeded
from qgs_plugintools.registry import check
from qgs_plugintools.trees import (
    cloned,
    described,
    difference,
    floating,
    leaves,
    mapped,
    not_finite,
)

Patch = tuple[int, int, int]  # view, row and column


@check({"head"})
def check_head_gives_gaussians(case: Case) -> None:
    """Quaternions are unit, scales positive, opacities inside (0, 1), colours inside [0, 1].

    With initial parameters too, for ordinary features. `sh` and `features` are there if the head
    provides them.
    """
    told = {name.removeprefix("gaussians.") for name in case.component.fields_written(case.config)}
    modules = [(case.build(), 1.0, "with initial parameters,")]
    modules += [(case.lively(), f, f"for features times {f:g}") for f in (0.0, 1.0, 100.0)]
    state = inputs_of(case)["state"]
    for module, factor, where in modules:
        for mode in each_mode(module):
            with seeded(0), torch.no_grad():
                out = module(state.replace(features=factor * state.features))
            given = {name for name in ("sh", "features") if getattr(out, name) is not None}
            expect(
                given == told, f"in {mode} it gives {given or None}, and provides {told or None}"
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
    """Weights are of existing layers, ascending, none negative, and sum to 1."""
    weights = dict(case.build().weights())
    layers = list(weights)
    expect(layers == sorted(set(layers)), f"layers are {layers}")
    known = all(isinstance(n, int) and 1 <= n <= case.dims.depth for n in layers)
    expect(known and bool(layers), f"of {case.dims.depth} layers it supervises {layers}")
    expect(min(weights.values()) >= 0, f"weights are {weights}")
    expect(abs(sum(weights.values()) - 1) < 1e-6, f"weights sum to {sum(weights.values()):g}")


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


@check({"losses"})
def check_loss_is_a_mean_over_scenes(case: Case) -> None:
    """The terms of a batch are the mean of those of its scenes."""
    module, inputs = case.lively(), inputs_of(case)
    alone = [module(*map_tensors(lambda x, s=s: x[s : s + 1], inputs).values()) for s in range(2)]
    found = difference(_mean(*alone), module(*inputs.values()), 1e-4, 1e-6)
    expect(not found, f"against the mean over scenes, {found}")


@check({"losses"})
def check_masked_queries_are_not_judged(case: Case) -> None:
    """What stands where the state's mask is False, with opacity 0, changes no term."""
    module, inputs = case.lively(), inputs_of(case)
    prediction, other = (inputs_of(case, seed=seed)["prediction"] for seed in range(2))
    batch, queries = prediction.state.features.shape[:2]
    mask_BN = (torch.arange(batch * queries) % 3 != 1).view(batch, queries)
    mask_BN = mask_BN.to(prediction.state.features.device)

    def seen(given: LayerPrediction) -> Any:
        opacities = given.gaussians.opacities * _over(mask_BN, given.gaussians.opacities)
        gaussians = replace(given.gaussians, opacities=opacities)
        state = replace(given.state, mask=mask_BN)
        return module(**{**inputs, "prediction": LayerPrediction(gaussians, state)})

    others = leaves(other)
    moved = mapped(prediction, lambda n, x: torch.where(_over(mask_BN, x), x, others[n]))
    found = difference(seen(prediction), seen(moved), 1e-4, 1e-6)
    expect(not found, f"when masked queries and their Gaussians change, {found}")


def _over(mask_BN: Tensor, x: Tensor) -> Tensor:
    """The mask of queries for a tensor of them or of their Gaussians, (B, N or G, 1, ...)."""
    of_each = mask_BN.repeat_interleave(x.shape[1] // mask_BN.shape[1], 1)
    return of_each.view(*of_each.shape, *[1] * (x.ndim - 2))


@check({"losses"})
def check_renderings_as_declared(case: Case) -> None:
    """A loss needs the renderings that `renderings` declares: of each view, of all, or none."""
    module, inputs = case.lively(), inputs_of(case)
    assert isinstance(module, Loss)
    terms = module(*inputs.values())
    for name, term in terms.items():
        expect(term.ndim == 0, f"the term `{name}` is of shape {tuple(term.shape)}, not 0-d")
    if module.renderings == "each":
        alone = []
        for view in range(2):
            seen = map_tensors(lambda x, v=view: x[:, v : v + 1], inputs["rendering"])
            target = inputs["target"].select([view])
            alone.append(module(inputs["prediction"], seen, target, inputs["inputs"]))
        found = difference(_mean(*alone), terms, 1e-4, 1e-6)
        expect(not found, f"`each` is declared; against the mean over views, {found}")


def _mean(one: dict[str, Tensor], other: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: (one[name] + other[name]) / 2 for name in one}


@check({"metrics"})
def check_metric_gives_its_columns(case: Case) -> None:
    """Given what it `needs` and no more, a metric has a finite value for each of its columns.

    The same each time; it changes nothing that it is given.
    """
    module = _metric(case)
    for noise in (0.0, 0.2):
        given = _metric_input(case, module, noise)
        before = cloned(given)
        values, again = (_values(module, given) for _ in range(2))
        keys = sorted(module.columns())
        expect(sorted(values) == keys, f"it has values for {sorted(values)}, columns for {keys}")
        broken = [key for key, value in values.items() if not value.isfinite().all()]
        expect(not broken, f"the values of the columns {broken} are not finite")
        expect(not difference(values, again), f"the second time {difference(values, again)}")
        found = difference(before, given)
        expect(not found, f"it changes what it is given: {found}")


@check({"metrics"})
def check_truth_scores_best(case: Case) -> None:
    """What equals the true images scores no worse than what does not, as `better` says."""
    module = _metric(case)
    true, false = (_values(module, _metric_input(case, module, noise)) for noise in (0.0, 0.2))
    for key, column in module.columns().items():
        pair = true[key].mean().item(), false[key].mean().item()
        seen = f"{column.heading} is {pair[0]:.4g} for the truth, {pair[1]:.4g} for a noisy image"
        expect(column.best(pair) == pair[0], f"{column.better} is better, but {seen}")


def _metric(case: Case) -> Metric:
    module = case.build()
    if module.unavailable:
        raise CannotCheck(module.unavailable)
    return module.eval()


def _metric_input(case: Case, module: Metric, noise: float) -> MetricInput:
    """True views, and images and depth that are off by `noise`; only what the metric needs."""
    maker = Maker(case, Sizes(batch=1), torch.Generator().manual_seed(0))
    needs, target = module.needs, maker.target()
    depth = maker.uniform(1, 2, 1, 2, 1, *maker.image)
    off = noise * maker.normal(*target.images.shape)
    return MetricInput(
        images=target.images + off,
        targets=target if "masks" in needs else replace(target, masks=None),
        gaussians=maker.gaussians() if "gaussians" in needs else None,
        gaussians_per_query=2,
        depth=depth + off[:, :, :1] if "depth" in needs else None,
        true_depth=depth if "true_depth" in needs else None,
    )


def _values(module: Metric, given: MetricInput) -> dict[str, Tensor]:
    with torch.no_grad():
        values = module(given)
    return {"": values} if isinstance(values, Tensor) else dict(values)


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


@check({"encoder"})
def check_patch_rays_are_those_of_the_grid(case: Case) -> None:
    """`grid` counts the patches of each view, `patch_rays` are their mean rays, in its order.

    A memory without rays may have no grid.
    """
    module = case.lively()
    for where, views in _wide_and_tall(case):
        memory = module(views)
        if memory.patch_rays is None:
            raise CannotCheck("it gives no patch rays")
        patch = _patch_size(where, views, memory)
        rays = patch_rays(plucker_rays(views.cameras), patch)
        found = difference({"patch_rays": memory.patch_rays}, {"patch_rays": rays}, 1e-4, 1e-5)
        expect(not found, f"{where}, against the mean rays of patches of {patch} pixels, {found}")


@check({"encoder"})
def check_tokens_are_those_of_the_grid(case: Case) -> None:
    """What one patch shows changes its own token most: that of its place in `grid`, if any.

    True of most of the patches, since a token may see far beyond its own. Keys may be those of the
    rays alone.
    """
    module = case.build().eval()
    for where, views in _wide_and_tall(case):
        views = map_tensors(lambda x: x[:1], views)
        memory = module(views)
        if memory.grid is None:
            declared = "memory.grid" in case.component.fields_written(case.config)
            expect(not declared, "`provides` says that there is a grid, and there is none")
            continue
        patch, grid = _patch_size(where, views, memory), memory.grid
        tokens = torch.randperm(math.prod(grid), generator=torch.Generator().manual_seed(0))
        places = _places(tokens[:12], grid)
        changed = module(_one_patch_each(views, places, patch))
        for name in ("keys", "values", "features"):
            if getattr(memory, name) is None:
                continue
            change = (changed[name] - memory[name]).square().sum(-1)
            change = change.sum(1) if change.ndim == 3 else change
            if not change.any():
                expect(name == "keys", f"{where}, `{name}` stays as it is when the images change")
                continue
            moved = _places(change.argmax(-1), grid)
            astray = [pair for pair in zip(places, moved, strict=True) if pair[0] != pair[1]]
            one, other = astray[0] if astray else (None, None)
            expect(
                2 * len(astray) < len(places),
                f"{where}, a change at view, row, column {one} changes most the token of "
                f"`{name}` at {other}, and so do {len(astray)} of {len(places)}",
            )


@check({"encoder"})
def check_project_makes_the_memory_again(case: Case) -> None:
    """Of its own features, a `tunable` encoder makes the memory that they came with.

    Of others it makes another one. An encoder that is not tunable refuses.
    """
    module = case.lively()
    memory = module(inputs_of(case)["views"])
    try:
        again = module.project(memory.features, memory)
        other = module.project(memory.features.roll(1, 1), memory)
    except NotImplementedError:
        expect(not module.tunable, "it is declared `tunable`, but `project` is not implemented")
        return
    expect(module.tunable, "it has `project`, but does not declare `tunable`")
    found = difference(memory, again)
    expect(not found, f"made anew from its own features, {found}")
    expect(bool(difference(memory, other)), "other features make the same memory")


def _wide_and_tall(case: Case) -> Iterator[tuple[str, Views]]:
    """Views of the size of the case and, where the component takes them, turned by 90 degrees."""
    height, width = case.size
    for size in dict.fromkeys([(height, width), (width, height)]):
        if size == case.size or not case.problems(size):
            where = f"with images of {size[0]} x {size[1]}"
            yield where, inputs_of(case, Sizes(image=size))["views"]


def _patch_size(where: str, views: Views, memory: ImageMemory) -> int:
    """Pixels along a patch, as the grid of `memory` says."""
    count, (height, width), grid = views.images.shape[1], views.cameras.size, memory.grid
    if grid is None:
        raise CannotCheck("its tokens are no patches: the memory has no grid")
    patch = max(height // max(grid[1], 1), 1)
    right = grid == (count, height / patch, width / patch)
    seen = f"{where} of {count} views, `grid` is {grid}, which is not (V, H/P, W/P) for any P"
    expect(right, seen)
    return patch


def _places(tokens: Tensor, grid: Patch) -> list[Patch]:
    return [*zip(*(x.tolist() for x in torch.unravel_index(tokens, grid)), strict=True)]


def _one_patch_each(views: Views, places: list[Patch], patch: int) -> Views:
    """A scene for each of `places`: the one given, with other noise in this one patch."""
    scenes = map_tensors(lambda x: x.expand(len(places), *x.shape[1:]).clone(), views)
    generator = torch.Generator().manual_seed(1)
    for images, (view, row, column) in zip(scenes.images, places, strict=True):
        seen = images[view, :, row * patch : (row + 1) * patch, column * patch :][..., :patch]
        seen.copy_(torch.rand(seen.shape, generator=generator))
    return scenes


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
    if given.geometry is None:
        state = inputs["state"]
        inputs["state"] = state.replace(
            features=state.features[:, :1].expand_as(state.features).clone()
        )
        given = _explanation(module, inputs) or given
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


@check({"encoder", "queries"})
def check_unread_cameras_make_no_difference(case: Case) -> None:
    """What declares `reads_cameras = False` gives the same without any cameras."""
    component = case.component
    if not issubclass(component, Encoder | Queries) or component.reads_cameras:
        raise CannotCheck("it reads cameras")
    module, inputs = case.lively(), inputs_of(case)
    views = inputs["views"]
    bare = Photos(views.images, views.times, views.target_time)
    found = difference(module(*inputs.values()), module(*{**inputs, "views": bare}.values()))
    expect(not found, f"without cameras, {found}")
