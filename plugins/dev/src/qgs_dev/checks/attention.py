"""Checks of encoders and attention: memory, masked queries, attention weights, patch grids."""

import math
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from qgs.containers import map_tensors
from qgs.contracts import Encoder, Queries
from qgs.geometry.rays import patch_rays, plucker_rays
from qgs.types import ImageMemory, Photos, QueryState, Size, Views
from qgs_dev.case import CannotCheck, Case
from qgs_dev.inputs import Inputs, Sizes, inputs_of
from qgs_dev.vocabulary import Trial, cast, difference, expect, expect_same, floating, masked, scene

# Queries of the state in which each query is masked in turn.
QUERIES = 6


def check_memo_is_of_the_memory_alone(case: Case) -> None:
    """Require that values stored with `ImageMemory.once` depend on the memory only.

    The values must not depend on the query state or on weights of a layer. A layer must give the
    same results on a new memory and on a memory that another layer has read before.
    """
    first = Trial(case)
    # The first layer fills the memo that the layers below read.
    first()
    memory = first.inputs["memory"]
    state = inputs_of(case, seed=1)["state"]
    for seed, what in enumerate(("the state", "a weight")):
        reader = case.lively(seed)
        fresh = reader(state, memory.replace())
        where = f"a value in `ImageMemory.once` depends on {what}: after another layer read it"
        expect_same(fresh, reader(state, memory), where)


def check_masked_queries_are_not_read(case: Case) -> None:
    """Require that queries with mask False do not change the results of unmasked queries."""
    sizes = Sizes(queries=5)
    trial = Trial(case, sizes)
    state = trial.inputs["state"]
    # The scenes have different masks, since a component may wrongly use one mask for all.
    mask = torch.tensor([[True, False, True, True, False], [True, True, False, True, True]])
    mask = mask.to(case.device)

    def seen(state: QueryState) -> Any:
        output = trial.state_of(trial(state=state.replace(mask=mask)))
        return {name: x[mask] for name, x in floating(output).items()}

    moved = masked(state, mask, inputs_of(case, sizes, seed=1)["state"])
    where = "other queries change when masked queries change"
    expect_same(seen(state), seen(moved), where, 1e-4, 1e-5)


def check_explanation_is_a_softmax(case: Case) -> None:
    """Require that weights from `explain` are the softmax of content plus geometry over tokens.

    Content and geometry are the two parts of the logits. Content must be (B, h, Q, T) for B scenes,
    h heads, the Q requested queries in their order and T tokens. Geometry must be (B, 1, Q, T) or
    (B, h, Q, T), with -inf where a token is hidden.
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
    expect(given.content.isfinite().all(), "content is not finite; put masks into geometry")
    expect(given.weights.shape == shape, f"weights are {tuple(given.weights.shape)}, not {shape}")
    if given.geometry is not None:
        found = tuple(given.geometry.shape)
        # Geometry is most often the same for all heads, and large.
        shared = (batch, 1, queries, tokens)
        expect(found in (shape, shared), f"geometry is {found}, neither {shape} nor {shared}")
    asked = [2, 0]
    some = explanation(trial.module, trial.inputs, asked)
    expect(some is not None, "`explain` returns None for queries 2 and 0, but not for all queries")
    where = "`explain` of queries 2 and 0 alone gives other weights"
    expect_same(some.weights, given.weights[:, :, asked], where, 1e-4, 1e-5)
    logits = given.content if given.geometry is None else given.content + given.geometry
    off = (given.weights - logits.softmax(-1)).abs().max().item()
    expect(off < 1e-3, f"weights are off the softmax of content and geometry by up to {off:.3g}")


def check_updates_are_explained(case: Case) -> None:
    """Require that updates are sums of values with the weights that `explain` returns.

    The values, one vector for each head and token, are not known here. But updates are linear in
    the values, and there are more updates (of many queries, or with several masks) than values. So
    a least-squares fit of the values to the updates must leave no residual.
    """
    count = QUERIES if case.slot == "self_attention" else 60
    module = case.lively().double()
    inputs = cast(inputs_of(case, Sizes(batch=1, queries=count)), torch.float64)
    masks = torch.ones(1, count, dtype=torch.bool)
    if case.slot == "self_attention":
        # Masking some queries does not change the values of the others.
        masks = torch.cat([masks, ~torch.eye(count, dtype=torch.bool)])
    factors = []
    updates = []
    for mask in masks:
        given = {**inputs, "state": inputs["state"].replace(mask=mask[None])}
        found = explanation(module, given)
        if found is None:
            return
        weights = found.weights[0, :, mask].double()  # (h, Q, N)
        # The bias of the output layer is one more unknown.
        bias = torch.ones(weights.shape[1], 1, dtype=torch.float64)
        factors.append(torch.cat([*weights, bias], 1))
        with torch.no_grad():
            updates.append(module(*given.values())[0, mask])
    factor = torch.cat(factors)
    update = torch.cat(updates)
    # The residual of the least squares is the part that no values explain.
    rest = update - factor @ torch.linalg.pinv(factor) @ update
    share = (rest.norm() / update.norm().clamp_min(1e-30)).item()
    seen = "the updates are no weighted sums of values with the weights from `explain`"
    expect(share < 1e-3, f"{seen}: {share:.1%} of them is unexplained")


def explanation(module: Any, inputs: Inputs, queries: list[int] | None = None) -> Any:
    """Return the attention weights that `explain` gives for the queries with indices `queries`.

    Without `queries`, return those of all queries. Return None if the component explains nothing.
    """
    chosen = queries or range(inputs["state"].features.shape[1])
    return module.explain(*inputs.values(), torch.tensor([*chosen]))


# Rows and columns of patches to change, each in a scene of its own; 4 if a token is a pixel.
_SIDE = 6

# Least share of a token's own patch, relative to the largest mean share at one displacement.
# Strided 3 x 3 convolutions, whose centres are nearly half a patch off, have 0.75 to 1.5. Tokens
# shifted by one have at most 0.5.
_LEAST_SHARE = 0.6

# Least share of a token's own patch over the mean share of a view's patches. Strided convolutions
# have at least 6, a random ViT of 8 blocks has 11.
_LEAST_GAIN = 1.5

_ORDER = (
    'order the tokens by view, then row, then column: `rearrange(x, "b v d h w -> b (v h w) d")`'
)


def check_patch_rays_are_those_of_the_grid(case: Case) -> None:
    """Require that `grid` counts the patches, and `patch_rays` are the rays of the patches.

    The grid has views, rows and columns of patches; rays must be in this order. The ray of a patch
    is the mean of the rays of its pixels. A memory without rays is not checked.
    """
    module = case.lively()
    for where, views in _wide_and_tall(case, case.size):
        memory = module(views)
        if memory.patch_rays is None:
            raise CannotCheck("the encoder's image memory has no patch rays")
        patch = _patch_size(where, views, memory)
        rays = patch_rays(plucker_rays(views.cameras), patch)
        where = f"{where}, compared with the mean rays of patches of {patch} pixels"
        expect_same({"patch_rays": memory.patch_rays}, {"patch_rays": rays}, where, 1e-4, 1e-5)


def check_tokens_are_those_of_the_grid(case: Case) -> None:
    """Require that a change of one patch changes the token at the same place in `grid` most.

    The changes are averaged over patches. A token may be centred half a patch off, as in strided
    convolutions. Keys may depend on rays alone, and not on the images. A memory without a grid is
    not checked.
    """
    # Initial parameters without noise: in a random network every token depends on all patches.
    module = case.build().eval()
    size = case.size
    grid = module(inputs_of(case)["views"]).grid
    large = (2 * size[0], 2 * size[1])
    # Most tokens of a small grid are at a border.
    if grid and min(grid[1:]) <= 3 and not case.image_size and not case.problems(large):
        size = large
    for where, views in _wide_and_tall(case, size):
        views = scene(views, 0)
        memory = module(views)
        if memory.grid is None:
            declared = "memory.grid" in case.writes
            expect(not declared, "`writes` lists memory.grid, but the memory's `grid` is None")
            continue
        patch = _patch_size(where, views, memory)
        side = _SIDE if patch > 1 else 4
        tokens = torch.arange(math.prod(memory.grid)).view(memory.grid)
        tokens = tokens[:, :side, :side].flatten()
        places = torch.stack(torch.unravel_index(tokens, memory.grid), -1)
        changed = module(_one_patch_each(views, places, patch))
        for name in ("keys", "values", "features"):
            if getattr(memory, name) is None:
                continue
            change = (changed[name] - memory[name]).square().sum(-1)
            # Keys and values have heads.
            change = change.sum(1) if change.ndim == 3 else change
            if not change.any():
                expect(name == "keys", f"{where}, `{name}` does not change when the images change")
                continue
            found = _misplaced(change, tokens, places, memory.grid)
            expect(not found, f"{where}, for `{name}`: {found}")


def check_project_makes_the_memory_again(case: Case) -> None:
    """Require that a `tunable` encoder can rebuild a memory from its features with `project`.

    Changed features must give a changed memory. An encoder that is not `tunable` must raise
    NotImplementedError.
    """
    trial = Trial(case)
    module = trial.module
    memory = trial()
    try:
        again = module.project(memory.features, memory)
        other = module.project(memory.features.roll(1, 1), memory)
    except NotImplementedError:
        expect(not module.tunable, "the encoder declares `tunable`, but does not have `project`")
        return
    expect(module.tunable, "the encoder has `project`, but does not declare `tunable`")
    expect_same(memory, again, "`project` of the memory's own features gives another memory")
    expect(difference(memory, other), "`project` of other features gives the same memory")


def _wide_and_tall(case: Case, size: Size) -> Iterator[tuple[str, Views]]:
    """Yield views of `size` (H, W), and of (W, H) if the component takes it, with descriptions."""
    for image in dict.fromkeys([size, (size[1], size[0])]):
        if image == size or not case.problems(image):
            where = f"with images of {image[0]} x {image[1]}"
            yield where, inputs_of(case, Sizes(image=image))["views"]


def _patch_size(where: str, views: Views, memory: ImageMemory) -> int:
    """Return the patch size in pixels that follows from the grid of `memory`."""
    grid = memory.grid
    if grid is None:
        raise CannotCheck("its tokens are not patches: the memory has no grid")
    count = views.images.shape[1]
    height, width = views.cameras.size
    patch = max(height // max(grid[1], 1), 1)
    seen = f"{where} of {count} views, `grid` is {grid}, which is not (V, H/P, W/P) for any P"
    expect(grid == (count, height / patch, width / patch), seen)
    return patch


def _misplaced(change: Tensor, changed: Tensor, places: Tensor, grid: tuple[int, int, int]) -> str:
    """Return how tokens are misplaced in `grid`, and how to fix that; "" if they are not misplaced.

    T patches of the photos were changed, one at a time. change: (T, M), the change that each patch
    caused in each of M tokens. changed: (T,), index of each patch's own token. places: view, row
    and column of each patch.
    """
    # Use shares of a token's total change: near borders and after norms, some tokens change more.
    share = change / change.sum(0).clamp_min(1e-30)
    # From the patch to the token.
    steps = (places - places[:, None]).flatten(0, 1)
    known, kind = steps.unique(dim=0, return_inverse=True)
    mean = kind.bincount(share[:, changed].flatten()) / kind.bincount()
    own = mean[(known == 0).all(-1)].item()
    most, at = mean.max(0)
    seen = f"{own:.0%} of what changes a token comes from its own patch"
    of_view = len(changed) / grid[0]
    if of_view > 4 and max(own, most / 2) * of_view < _LEAST_GAIN:
        return f"{seen}, hardly more than from others; {_ORDER}"
    if own < _LEAST_SHARE * most:
        step = ", ".join(f"{-x:+d}" for x in known[at].tolist())
        return (
            f"{seen}, {most:.0%} from the patch at view, row, column ({step}) of it; "
            f"{_ORDER}, and pad so that the receptive field of a token is centred on its patch"
        )
    return ""


def _one_patch_each(views: Views, places: Tensor, patch: int) -> Views:
    """Return copies of a scene, one for each patch in `places`, with new noise in this patch.

    places: view, row and column of each patch. patch: side of a patch in pixels.
    """
    scenes = map_tensors(lambda x: x.repeat_interleave(len(places), 0), views)
    generator = torch.Generator().manual_seed(1)
    for images, (view, row, column) in zip(scenes.images, (places * patch).tolist(), strict=True):
        # Writing in place is safe, because these scenes are copies.
        seen = images[view // patch, :, row : row + patch, column : column + patch]
        seen.copy_(torch.rand(seen.shape, generator=generator))
    return scenes


def check_unread_cameras_make_no_difference(case: Case) -> None:
    """Require the same results without cameras from a component with `reads_cameras` False."""
    component = case.component
    if not issubclass(component, Encoder | Queries) or component.reads_cameras:
        raise CannotCheck("this check is only for components with reads_cameras False")
    trial = Trial(case)
    views = trial.inputs["views"]
    bare = Photos(views.images, views.times, views.target_time)
    expect_same(trial(), trial(views=bare), "without cameras")
