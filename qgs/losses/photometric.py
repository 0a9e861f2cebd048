"""`qgs/photometric`: MSE, L1 and SSIM of rendered against true images (TokenGS, LocusGS)."""

from collections.abc import Iterable, Iterator
from typing import Literal

import torch
import torch.nn.functional as F
from pydantic import Field
from torch import Tensor

from qgs.contracts import Loss, Problem, RecipeContext
from qgs.geometry.precision import full_precision
from qgs.types import LayerPrediction, Rendering, Views

WINDOW = 11
SIGMA = 1.5
C1, C2 = 0.01**2, 0.03**2

Padding = Literal["same", "valid"]


@full_precision
def mean_ssim(images: Tensor, truth: Tensor, padding: Padding) -> Tensor:
    """Mean structural similarity, 0-d, of images (..., H, W) in [0, 1] (Wang et al. 2004).

    padding: "same" pads with zeros, as the releases do; "valid" uses windows inside the image, and
    raises ValueError for images smaller than one.
    """
    height, width = images.shape[-2:]
    if padding == "valid" and min(height, width) < WINDOW:
        raise ValueError(
            f'SSIM with padding "valid" needs images of at least {WINDOW} pixels a side, got '
            f"{height} x {width}; raise data.image_size or use padding: same"
        )
    # Two products with band matrices: faster on a CPU than convolutions, and their gradients too.
    moments = torch.stack([images, truth, images * images, truth * truth, images * truth])
    along_rows = moments @ _window(width, padding).to(moments)
    blurred = along_rows.transpose(-1, -2) @ _window(height, padding).to(moments)
    mean_x, mean_y, square_x, square_y, product = blurred
    luminance = 2 * mean_x * mean_y + C1
    structure = 2 * (product - mean_x * mean_y) + C2
    energy = mean_x.square() + mean_y.square()
    # Variances as differences of squares lose digits, which is why this runs in float32 at least.
    spread = square_x + square_y - energy + C2
    return (luminance * structure / ((energy + C1) * spread)).mean()


def _window(size: int, padding: Padding) -> Tensor:
    """(size, outputs) matrix that blurs along one axis: column j weighs the pixels around j."""
    position = torch.arange(size, dtype=torch.float64)
    offset = position[:, None] - position
    weight = torch.exp(-(offset**2) / (2 * SIGMA**2)) * (offset.abs() <= WINDOW // 2)
    reach = torch.arange(-(WINDOW // 2), WINDOW // 2 + 1)
    weight = weight / torch.exp(-(reach**2) / (2 * SIGMA**2)).sum()
    return weight if padding == "same" else weight[:, WINDOW // 2 : size - WINDOW // 2]


class Photometric(Loss):
    """mse_weight * MSE + l1_weight * L1 + ssim_weight * (1 - SSIM) / 2, three terms."""

    name = "photometric"
    scheduled = frozenset({"weight", "mse_weight", "l1_weight", "ssim_weight"})
    renderings = "each"

    class Config(Loss.Config):
        mse_weight: float = Field(default=1.0, ge=0)
        """Factor of the mean squared error; 0 leaves the term out."""
        l1_weight: float = Field(default=0.0, ge=0)
        """Factor of the mean absolute error (TokenGS 2026.6: 0.8, without MSE); 0 leaves it out."""
        ssim_weight: float = Field(default=0.2, ge=0)
        """Factor of (1 - SSIM) / 2; 0 leaves the term out."""
        padding: Padding = "same"
        """Borders of SSIM: "same" pads with zeros (releases), "valid" uses whole windows only."""

    config: Config

    @classmethod
    def problems(cls, config: Config, context: RecipeContext) -> Iterable[Problem]:
        if config.ssim_weight and config.padding == "valid":
            yield from too_small(context, WINDOW, "padding", "SSIM of whole windows")

    def weights(self) -> tuple[float, float, float]:
        """Of MSE, L1 and SSIM in the objective."""
        c = self.config
        return c.weight * c.mse_weight, c.weight * c.l1_weight, c.weight * c.ssim_weight

    def term(
        self, prediction: LayerPrediction, rendering: Rendering, target: Views, inputs: Views
    ) -> dict[str, Tensor]:
        """Terms `mse`, `l1`, `ssim`; raises ValueError for images that are too small for SSIM."""
        terms = {}
        if self.config.mse_weight:
            terms["mse"] = self.config.mse_weight * mean_squared_error(rendering.rgb, target.images)
        if self.config.l1_weight:
            terms["l1"] = self.config.l1_weight * F.l1_loss(rendering.rgb, target.images)
        if self.config.ssim_weight:
            similarity = mean_ssim(rendering.rgb, target.images, self.config.padding)
            terms["ssim"] = self.config.ssim_weight * (1 - similarity) / 2
        return terms


def too_small(context: RecipeContext, side: int, option: str, measure: str) -> Iterator[Problem]:
    """A problem of `option` where the data's images have a side below `side` pixels."""
    if context.image_size and min(context.image_size) < side:
        given = "{} x {} (H x W)".format(*context.image_size)
        reason = f"{measure} needs images of at least {side} pixels a side, the data's are {given}"
        yield Problem(option, reason, "raise data.image_size, or do without it")


@full_precision
def mean_squared_error(images: Tensor, truth: Tensor) -> Tensor:
    """Mean over everything of (images - truth)^2."""
    return F.mse_loss(images, truth)
