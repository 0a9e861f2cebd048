"""`qgs/photometric`: rendered against true images (TokenGS, LocusGS)."""

from __future__ import annotations

from typing import ClassVar

import torch.nn.functional as F
from pydantic import Field
from torch import Tensor

from qgs.contracts import ComponentConfig, Loss
from qgs.geometry.precision import full_precision
from qgs.losses.ssim import Padding, mean_ssim
from qgs.types import LayerPrediction, Rendering, Views


class Photometric(Loss):
    """mse_weight * MSE + ssim_weight * (1 - SSIM) / 2."""

    name: ClassVar[str] = "photometric"
    renderings = "each"

    class Config(ComponentConfig):
        """mse_weight, ssim_weight: of the two terms, as published.

        padding: of the SSIM window, see `qgs.losses.ssim.mean_ssim`.
        """

        mse_weight: float = Field(default=1.0, ge=0)
        ssim_weight: float = Field(default=0.2, ge=0)
        padding: Padding = "same"

    config: Config

    def forward(
        self, prediction: LayerPrediction, rendering: Rendering, target: Views
    ) -> dict[str, Tensor]:
        """Terms `mse` and `ssim`; a term with weight 0 is left out.

        Raises ValueError when images are too small for the SSIM window.
        """
        terms = {}
        if self.config.mse_weight:
            terms["mse"] = self.config.mse_weight * mean_squared_error(rendering.rgb, target.images)
        if self.config.ssim_weight:
            similarity = mean_ssim(rendering.rgb, target.images, self.config.padding)
            terms["ssim"] = self.config.ssim_weight * (1 - similarity) / 2
        return terms


@full_precision
def mean_squared_error(images: Tensor, truth: Tensor) -> Tensor:
    """Mean over everything of (images - truth)^2."""
    return F.mse_loss(images, truth)
