"""Where the tokens of an image memory stand: in which view, row and column."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import torch
from torch import Tensor

from qgs.geometry.rays import patch_rays, plucker_rays
from qgs.testing.case import Case
from qgs.testing.faults import expect
from qgs.testing.registry import check
from qgs.testing.subjects import Sizes, inputs_of
from qgs.testing.trees import distance, mapped
from qgs.types import ImageMemory, Views

PATCHES = 12
"""How many patches are changed, one at a time."""

Place = tuple[int, int, int]
"""View, row and column."""


@check({"encoder"})
def check_patch_rays_are_those_of_the_grid(case: Case) -> None:
    """`grid` counts the patches of each view, `patch_rays` are their mean rays, in its order."""
    module = case.lively()
    for where, views in _wide_and_tall(case):
        memory = module(views)
        patch = _patch_size(where, views, memory)
        rays = patch_rays(plucker_rays(views.cameras), patch)
        found = distance({"patch_rays": memory.patch_rays}, {"patch_rays": rays}, 1e-4, 1e-5)
        expect(not found, f"{where}, against the mean rays of patches of {patch} pixels, {found}")


@check({"encoder"})
def check_tokens_are_those_of_the_grid(case: Case) -> None:
    """What one patch shows changes its own token most: that of its place in `grid`.

    Held to most of the patches, since a token may see far beyond its own.
    """
    module = case.build().eval()
    for where, views in _wide_and_tall(case):
        views = mapped(views, lambda _, x: x[:1])
        memory = module(views)
        patch, grid = _patch_size(where, views, memory), memory.grid
        tokens = torch.randperm(math.prod(grid), generator=torch.Generator().manual_seed(0))
        places = [_place(int(token), grid) for token in tokens[:PATCHES]]
        changed = module(_one_patch_each(views, places, patch))
        for name in ("keys", "values", "features"):
            before, after = getattr(memory, name), getattr(changed, name)
            moved = [_place(int(token), grid) for token in _most_changed(before, after)]
            astray = [pair for pair in zip(places, moved, strict=True) if pair[0] != pair[1]]
            one, other = astray[0] if astray else (None, None)
            expect(
                2 * len(astray) < len(places) or not bool((before != after).any()),
                f"{where}, a change at view, row, column {one} changes most the token of "
                f"`{name}` at {other}, and so do {len(astray)} of {len(places)}",
            )


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
    patch = height // max(grid[1], 1)
    expect(
        grid == (count, height // max(patch, 1), width // max(patch, 1))
        and (grid[1] * patch, grid[2] * patch) == (height, width),
        f"{where} of {count} views, `grid` is {grid}, which is not (V, H/P, W/P) for any P",
    )
    return patch


def _place(token: int, grid: tuple[int, int, int]) -> Place:
    _, rows, columns = grid
    return token // (rows * columns), token // columns % rows, token % columns


def _one_patch_each(views: Views, places: list[Place], patch: int) -> Views:
    """A scene for each of `places`: the one given, with other noise in this one patch."""
    scenes = mapped(views, lambda _, x: x.expand(len(places), *x.shape[1:]).clone())
    generator = torch.Generator().manual_seed(1)
    for images, (view, row, column) in zip(scenes.images, places, strict=True):
        seen = images[view, :, row * patch : (row + 1) * patch, column * patch :][..., :patch]
        seen.copy_(torch.rand(seen.shape, generator=generator))
    return replace(views, images=scenes.images, cameras=scenes.cameras)


def _most_changed(before: Tensor, after: Tensor) -> Tensor:
    """(S,) the token of each of S scenes that differs most from that of the scene before.

    (1, M, D) or (1, h, M, D/h), and the same for S scenes.
    """
    change = (after - before).square().sum(-1)
    return (change.sum(1) if change.ndim == 3 else change).argmax(-1)
