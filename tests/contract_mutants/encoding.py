"""Encoders whose tokens are not where their grid and their rays say."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import torch
from torch import Tensor

from qgs.components import MultiViewViT
from qgs.types import ImageMemory, Views


class ForgetsItsRays(MultiViewViT):
    name: ClassVar[str] = "forgets_its_rays"

    def forward(self, views: Views) -> ImageMemory:
        memory = super().forward(views)
        return replace(memory, patch_rays=torch.zeros_like(memory.patch_rays))


class RoundsItsRays(MultiViewViT):
    name: ClassVar[str] = "rounds_its_rays"

    def forward(self, views: Views) -> ImageMemory:
        memory = super().forward(views)
        return replace(memory, patch_rays=memory.patch_rays.bfloat16().to(memory.patch_rays))


class TurnsItsGrid(MultiViewViT):
    """It counts columns, then rows."""

    name: ClassVar[str] = "turns_its_grid"

    def forward(self, views: Views) -> ImageMemory:
        memory = super().forward(views)
        count, rows, columns = memory.grid
        return replace(memory, grid=(count, columns, rows))


class GoesByColumns(MultiViewViT):
    """Its tokens go column by column, its rays row by row."""

    name: ClassVar[str] = "goes_by_columns"

    def forward(self, views: Views) -> ImageMemory:
        memory = super().forward(views)

        def turned(x: Tensor, tokens: int) -> Tensor:
            x = x.unflatten(tokens, memory.grid).transpose(tokens + 1, tokens + 2)
            return x.flatten(tokens, tokens + 2)

        return replace(
            memory,
            keys=turned(memory.keys, 2),
            values=turned(memory.values, 2),
            features=turned(memory.features, 1),
        )


class MixesUpItsViews(MultiViewViT):
    """Its values are of the views in reverse."""

    name: ClassVar[str] = "mixes_up_its_views"

    def forward(self, views: Views) -> ImageMemory:
        memory = super().forward(views)
        values = memory.values.unflatten(2, (memory.grid[0], -1)).flip(2)
        return replace(memory, values=values.flatten(2, 3))


class FlipsTallImages(MultiViewViT):
    name: ClassVar[str] = "flips_tall_images"

    def forward(self, views: Views) -> ImageMemory:
        height, width = views.cameras.size
        images = views.images.flip(-2) if height > width else views.images
        return super().forward(replace(views, images=images))
