"""Components that know the order of the views, or only say so."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import torch
from torch import Tensor

from qgs.components import ContentCrossAttention, MultiViewViT
from qgs.contracts import Loss
from qgs.renderers import TorchRenderer
from qgs.types import Cameras, Gaussians, ImageMemory, LayerPrediction, Rendering, Views


def _numbers(views: int, like: Tensor) -> Tensor:
    return torch.arange(1.0, views + 1).to(like)


class DeclaresAnOrder(ContentCrossAttention):
    name: ClassVar[str] = "declares_an_order"
    ordered_views = True


class DeclaresAnOrderOfPhotos(MultiViewViT):
    name: ClassVar[str] = "declares_an_order_of_photos"
    ordered_views = True


class NumbersPhotos(MultiViewViT):
    name: ClassVar[str] = "numbers_photos"

    def forward(self, views: Views) -> ImageMemory:
        number = _numbers(views.images.shape[1], views.images)
        return super().forward(replace(views, images=views.images / number[:, None, None, None]))


class DimsLaterViews(TorchRenderer):
    name: ClassVar[str] = "dims_later_views"

    def forward(
        self, gaussians: Gaussians, cameras: Cameras, background: Tensor | None = None
    ) -> Rendering:
        out = super().forward(gaussians, cameras, background)
        return replace(
            out, depth=out.depth / _numbers(out.depth.shape[1], out.depth)[:, None, None, None]
        )


class WeighsTheFirstView(Loss):
    name: ClassVar[str] = "weighs_the_first_view"

    def forward(
        self, prediction: LayerPrediction, rendering: Rendering, target: Views
    ) -> dict[str, Tensor]:
        error = (rendering.rgb - target.images).square().mean((0, 2, 3, 4))
        return {"error": (error / _numbers(len(error), error)).sum()}
