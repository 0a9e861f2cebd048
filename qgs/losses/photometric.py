"""`qgs/photometric`: rendered against true images (TokenGS, LocusGS)."""

from __future__ import annotations

from typing import ClassVar, Literal

import torch.nn.functional as F
from kornia.metrics import ssim
from pydantic import Field
from torch import Tensor

from qgs.contracts import ComponentConfig, Loss
from qgs.geometry.precision import full_precision
from qgs.types import LayerPrediction, Rendering, Views

SSIM_WINDOW = 11


class Photometric(Loss):
    """mse_weight * MSE + ssim_weight * (1 - SSIM) / 2."""

    name: ClassVar[str] = "photometric"

    class Config(ComponentConfig):
        """Weights as published.

        padding: "same" looks at every pixel, windows at the border on mirrored images (the releases
        pad with zeros); "valid" leaves out the 5 pixels at the border.
        """

        mse_weight: float = Field(default=1.0, ge=0)
        ssim_weight: float = Field(default=0.2, ge=0)
        padding: Literal["same", "valid"] = "same"

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
            similarity = _mean_ssim(rendering.rgb, target.images, self.config.padding)
            terms["ssim"] = self.config.ssim_weight * (1 - similarity) / 2
        return terms


@full_precision
def mean_squared_error(images: Tensor, truth: Tensor) -> Tensor:
    """Mean over everything of (images - truth)^2."""
    return F.mse_loss(images, truth)


@full_precision
def _mean_ssim(images: Tensor, truth: Tensor, padding: str) -> Tensor:
    smallest = SSIM_WINDOW if padding == "valid" else SSIM_WINDOW // 2 + 1
    if min(images.shape[-2:]) < smallest:
        raise ValueError(
            f"SSIM with padding {padding!r} needs images of at least {smallest} pixels a side, got "
            f"{images.shape[-2]}x{images.shape[-1]}; raise data.image_size or set ssim_weight to 0"
        )
    return ssim(images.flatten(0, 1), truth.flatten(0, 1), SSIM_WINDOW, padding=padding).mean()
