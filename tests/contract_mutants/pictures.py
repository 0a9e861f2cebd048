"""Renderers, losses and a supervision that are sound but for one thing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import count
from typing import ClassVar

from qgs_rooms.source import RoomsSource
from torch import Tensor

from qgs.components import LayerSupervision
from qgs.contracts import Loss, Scene, Split
from qgs.losses import Photometric
from qgs.renderers import TorchRenderer
from qgs.types import Cameras, Gaussians, LayerPrediction, Rendering, Views

_opened = count()


class DoublesAGradient(TorchRenderer):
    name: ClassVar[str] = "doubles_a_gradient"

    def forward(
        self, gaussians: Gaussians, cameras: Cameras, background: Tensor | None = None
    ) -> Rendering:
        colors = 2 * gaussians.colors - gaussians.colors.detach()
        return super().forward(replace(gaussians, colors=colors), cameras, background)


class KnowsTheOrigin(TorchRenderer):
    name: ClassVar[str] = "knows_the_origin"

    def forward(
        self, gaussians: Gaussians, cameras: Cameras, background: Tensor | None = None
    ) -> Rendering:
        colors = gaussians.colors * gaussians.means[..., 2:].sigmoid()
        return super().forward(replace(gaussians, colors=colors), cameras, background)


class HasItsOwnBackground(TorchRenderer):
    name: ClassVar[str] = "has_its_own_background"

    def forward(
        self, gaussians: Gaussians, cameras: Cameras, background: Tensor | None = None
    ) -> Rendering:
        return super().forward(gaussians, cameras)


class MisstatesAlpha(TorchRenderer):
    name: ClassVar[str] = "misstates_alpha"

    def forward(
        self, gaussians: Gaussians, cameras: Cameras, background: Tensor | None = None
    ) -> Rendering:
        out = super().forward(gaussians, cameras, background)
        return replace(out, alpha=out.alpha.square())


class MeasuresFromTheOrigin(Loss):
    name: ClassVar[str] = "measures_from_the_origin"
    renderings = "none"

    def forward(
        self, prediction: LayerPrediction, rendering: Rendering, target: Views
    ) -> dict[str, Tensor]:
        return {"far": prediction.gaussians.means.square().mean()}


class SumsOverScenes(Loss):
    name: ClassVar[str] = "sums_over_scenes"
    renderings = "each"

    def forward(
        self, prediction: LayerPrediction, rendering: Rendering, target: Views
    ) -> dict[str, Tensor]:
        return {"error": (rendering.rgb - target.images).square().mean((1, 2, 3, 4)).sum()}


class TakesTheWorstView(Photometric):
    name: ClassVar[str] = "takes_the_worst_view"
    renderings = "each"

    def forward(
        self, prediction: LayerPrediction, rendering: Rendering, target: Views
    ) -> dict[str, Tensor]:
        error = (rendering.rgb - target.images).square().mean((2, 3, 4))
        return {"error": error.amax(1).mean()}


class NeverTheSame(RoomsSource):
    name: ClassVar[str] = "never_the_same"

    def scenes(self, split: Split) -> Sequence[Scene]:
        return super().scenes(split)[next(_opened) :]


class WeighsTwice(LayerSupervision):
    name: ClassVar[str] = "weighs_twice"

    def weights(self) -> Mapping[int, float]:
        return {layer: 2 * weight for layer, weight in super().weights().items()}
