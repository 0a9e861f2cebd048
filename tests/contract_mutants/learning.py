"""Components whose gradients stop, or lead elsewhere than to what they should."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import torch
from contract_mutants.modules import PLACE
from torch import Tensor

from qgs.components import (
    ContentCrossAttention,
    ContentSelfAttention,
    FreeCenters,
    MlpFeedForward,
    MultiViewViT,
)
from qgs.components.blocks import merge_heads
from qgs.contracts import ComponentConfig, Fields, Loss
from qgs.renderers import TorchRenderer
from qgs.types import (
    Cameras,
    Gaussians,
    ImageMemory,
    LayerPrediction,
    QueryState,
    Rendering,
    Views,
)


class DetachedLoss(Loss):
    name: ClassVar[str] = "detached_loss"
    renderings = "each"

    def forward(
        self, prediction: LayerPrediction, rendering: Rendering, target: Views
    ) -> dict[str, Tensor]:
        return {"error": (rendering.rgb.detach() - target.images.detach()).square().mean()}


class HasAnIdleTerm(Loss):
    """One of its terms trains nothing, although its gradient is what differences say."""

    name: ClassVar[str] = "has_an_idle_term"
    renderings = "each"

    def forward(
        self, prediction: LayerPrediction, rendering: Rendering, target: Views
    ) -> dict[str, Tensor]:
        error = (rendering.rgb - target.images).square().mean()
        return {"error": error, "contrast": target.images.square().mean()}


class DetachedAttention(ContentCrossAttention):
    """Passes on what was learned, and nothing of the images."""

    name: ClassVar[str] = "detached_attention"

    def forward(self, state: QueryState, memory: ImageMemory) -> Tensor:
        seen = super().forward(state, memory)
        return self.core.out_proj(merge_heads(self.core.project(state.features))) + 0 * seen


class IgnoresWhereItIs(ContentSelfAttention):
    """Reads a field that leaves no trace in what it computes."""

    name: ClassVar[str] = "ignores_where_it_is"

    @classmethod
    def requires(cls, config: ComponentConfig) -> Fields:
        return PLACE

    def forward(self, state: QueryState) -> Tensor:
        return super().forward(state) + 0 * state["place.center"].sum(-1, keepdim=True)


class TakesRootsOfZero(MlpFeedForward):
    """In training, a gradient that is not a number, although every number is one."""

    name: ClassVar[str] = "takes_roots_of_zero"

    def forward(self, features: Tensor) -> Tensor:
        update = super().forward(features)
        return update + (0 * features).sqrt() if self.training else update


class LearnsAConstant(MlpFeedForward):
    name: ClassVar[str] = "learns_a_constant"

    def forward(self, features: Tensor) -> Tensor:
        return super().forward(torch.zeros_like(features))


class StandsStill(FreeCenters):
    name: ClassVar[str] = "stands_still"

    def forward(self, offsets: Tensor, state: QueryState) -> Tensor:
        return super().forward(torch.zeros_like(offsets), state)


class ClosesItsEyes(MultiViewViT):
    name: ClassVar[str] = "closes_its_eyes"

    def forward(self, views: Views) -> ImageMemory:
        return super().forward(replace(views, images=0 * views.images))


class ForgetsDepth(TorchRenderer):
    """No gradient in one coordinate of the means."""

    name: ClassVar[str] = "forgets_depth"

    def forward(
        self, gaussians: Gaussians, cameras: Cameras, background: Tensor | None = None
    ) -> Rendering:
        x, y, z = gaussians.means.unbind(-1)
        means = torch.stack([x, y, z.detach()], -1)
        return super().forward(replace(gaussians, means=means), cameras, background)


class TurnsPosesOnly(TorchRenderer):
    """A gradient in where a camera looks, and none in where it stands."""

    name: ClassVar[str] = "turns_poses_only"

    def forward(
        self, gaussians: Gaussians, cameras: Cameras, background: Tensor | None = None
    ) -> Rendering:
        turned, position = cameras.c2w[..., :3], cameras.c2w[..., 3:].detach()
        cameras = replace(cameras, c2w=torch.cat([turned, position], -1))
        return super().forward(gaussians, cameras, background)


class HoldsItsLens(TorchRenderer):
    """Leaves intrinsics without a gradient and says nothing."""

    name: ClassVar[str] = "holds_its_lens"
    camera_gradients = ("c2w",)

    def forward(
        self, gaussians: Gaussians, cameras: Cameras, background: Tensor | None = None
    ) -> Rendering:
        cameras = replace(cameras, intrinsics=cameras.intrinsics.detach())
        return super().forward(gaussians, cameras, background)


class RefusesWhatItDeclares(TorchRenderer):
    name: ClassVar[str] = "refuses_what_it_declares"

    def forward(
        self, gaussians: Gaussians, cameras: Cameras, background: Tensor | None = None
    ) -> Rendering:
        if cameras.intrinsics.requires_grad:
            raise ValueError("there is no gradient of intrinsics; detach them")
        return super().forward(gaussians, cameras, background)


class DeclaresAGradientInSize(TorchRenderer):
    name: ClassVar[str] = "declares_a_gradient_in_size"
    camera_gradients = ("c2w", "size")
