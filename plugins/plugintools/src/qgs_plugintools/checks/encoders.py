"""What encoders alone promise."""

import math
from collections.abc import Iterator

import torch
from torch import Tensor

from qgs.contracts import (
    Encoder,
    Queries,
)
from qgs.geometry.rays import patch_rays, plucker_rays
from qgs.types import (
    ImageMemory,
    Photos,
    Views,
    map_tensors,
)
from qgs_plugintools.case import CannotCheck, Case, expect
from qgs_plugintools.inputs import Sizes, inputs_of
from qgs_plugintools.registry import check
from qgs_plugintools.trees import (
    difference,
)

Patch = tuple[int, int, int]  # view, row and column


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
