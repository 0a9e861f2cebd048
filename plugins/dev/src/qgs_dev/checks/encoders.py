"""What encoders alone promise."""

import math
from collections.abc import Iterator

import torch
from torch import Tensor

from qgs.containers import map_tensors
from qgs.contracts import (
    Encoder,
    Queries,
)
from qgs.geometry.rays import patch_rays, plucker_rays
from qgs.types import ImageMemory, Photos, Views
from qgs_dev.case import CannotCheck, Case, expect
from qgs_dev.inputs import Sizes, inputs_of
from qgs_dev.registry import check
from qgs_dev.trees import (
    difference,
)

Patch = tuple[int, int, int]  # view, row and column

_SIDE = 6
"""Rows and columns of patches that are changed, a scene each; 4 where a token is a pixel."""

_LEAST_SHARE = 0.6
"""Of the largest mean share at one displacement. Strided 3 x 3 convolutions, whose centres are
nearly half a patch off, have 0.75 to 1.5; tokens shifted by one at most 0.5."""

_LEAST_GAIN, _GOOD_GAIN = 1.5, 3
"""Share of a token's own patch over the mean of a view's: what it must have, and what shows the
true order. Strided convolutions have at least 6, a random ViT of 8 blocks 11."""

_ORDER = (
    'order the tokens by view, then row, then column: `rearrange(x, "b v d h w -> b (v h w) d")`'
)


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

    In the mean over the patches, and half a patch off is allowed: the centres of strided
    convolutions stand there. Keys may be those of the rays alone.
    """
    module = case.build().eval()
    for where, views in _wide_and_tall(case, _size_of_a_large_grid(case, module)):
        views = map_tensors(lambda x: x[:1], views)
        memory = module(views)
        if memory.grid is None:
            declared = "memory.grid" in case.component.fields_written(case.config)
            expect(not declared, "`writes` has memory.grid, but `grid` of the ImageMemory is None")
            continue
        patch, grid = _patch_size(where, views, memory), memory.grid
        side = _SIDE if patch > 1 else 4
        tokens = torch.arange(math.prod(grid)).view(grid)[:, :side, :side].flatten()
        changed = module(_one_patch_each(views, _places(tokens, grid), patch))
        for name in ("keys", "values", "features"):
            if getattr(memory, name) is None:
                continue
            change = (changed[name] - memory[name]).square().sum(-1)
            change = change.sum(1) if change.ndim == 3 else change
            if not change.any():
                expect(name == "keys", f"{where}, `{name}` stays as it is when the images change")
                continue
            found = _misplaced(change, tokens, grid)
            expect(not found, f"{where}, of `{name}`, {found}")


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


def _wide_and_tall(case: Case, size: tuple[int, int] | None = None) -> Iterator[tuple[str, Views]]:
    """Views of `size` (H, W), by default that of the case, and turned by 90 degrees if possible."""
    height, width = first = size or case.size
    for size in dict.fromkeys([first, (width, height)]):
        if size == first or not case.problems(size):
            where = f"with images of {size[0]} x {size[1]}"
            yield where, inputs_of(case, Sizes(image=size))["views"]


def _size_of_a_large_grid(case: Case, module: Encoder) -> tuple[int, int]:
    """(H, W) of the case, doubled if its grid is so small that most tokens are at a border."""
    height, width = case.size
    grid = module(inputs_of(case)["views"]).grid
    large = 2 * height, 2 * width
    if grid is None or case.image_size or min(grid[1:]) > 3 or case.problems(large):
        return case.size
    return large


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


def _misplaced(change: Tensor, changed: Tensor, grid: Patch) -> str:
    """How tokens of the `grid` stand off their patches, with the remedy; "" if they do not.

    change: (T, M), of each token by each of the patches that were `changed` (T,).
    """
    # Shares of what changes a token: near borders, and after norms, some tokens change more.
    share = change / change.sum(0).clamp_min(1e-30)
    places = torch.stack(torch.unravel_index(changed, grid), -1)
    steps = (places - places[:, None]).flatten(0, 1)  # from the patch to the token
    known, kind = steps.unique(dim=0, return_inverse=True)
    mean = share.new_zeros(len(known)).index_add(0, kind, share[:, changed].flatten())
    mean = mean / kind.bincount()
    own = mean[(known == 0).all(-1)].item()
    most, at = mean.max(0)
    views, rows, columns = grid
    by_column = torch.arange(math.prod(grid)).view(views, columns, rows).mT.flatten()
    exchanged = share[range(len(changed)), by_column[changed]].mean().item()
    seen = f"{own:.0%} of what changes a token comes from its own patch"
    of_view = len(changed) / views
    if exchanged * of_view > _GOOD_GAIN and exchanged > 2 * own:
        return f"{seen}, {exchanged:.0%} if tokens were ordered by view, column, row; {_ORDER}"
    if of_view > 4 and max(own, most / 2) * of_view < _LEAST_GAIN:
        return (
            f"{seen}, hardly more than from others: let it show in each token what its patch shows"
        )
    if own < _LEAST_SHARE * most:
        step = ", ".join(f"{-x:+d}" for x in known[at].tolist())
        return (
            f"{seen}, {most:.0%} from the patch at view, row, column ({step}) of it; "
            f"{_ORDER}, and pad so that the pixels which a token sees are centred on its patch"
        )
    return ""


def _one_patch_each(views: Views, places: list[Patch], patch: int) -> Views:
    """A scene for each of `places`: the one given, with other noise in this one patch."""
    scenes = map_tensors(lambda x: x.expand(len(places), *x.shape[1:]).clone(), views)
    generator = torch.Generator().manual_seed(1)
    for images, (view, row, column) in zip(scenes.images, places, strict=True):
        seen = images[view, :, row * patch : (row + 1) * patch, column * patch :][..., :patch]
        seen.copy_(torch.rand(seen.shape, generator=generator))
    return scenes


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
