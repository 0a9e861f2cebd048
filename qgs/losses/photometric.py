"""Losses on images, masks and opacities: `qgs/photometric`, `qgs/mask`, `qgs/opacity`."""

from collections.abc import Iterable, Iterator

import torch.nn.functional as F
from pydantic import NonNegativeFloat, PositiveFloat
from torch import Tensor

from qgs.contracts import Loss, Problem, RecipeContext
from qgs.precision import at_least_float32, full_precision
from qgs.similarity import WINDOW, Padding, mean_ssim
from qgs.types import LayerPrediction, Rendering, Views


class Photometric(Loss):
    """Photometric loss: mse_weight * MSE + l1_weight * L1 + ssim_weight * (1 - SSIM) / 2.

    It compares renderings with the images of the target views.
    """

    name = "photometric"
    scheduled = frozenset({"weight", "mse_weight", "l1_weight", "ssim_weight"})
    renderings = "each"

    class Config(Loss.Config):
        mse_weight: NonNegativeFloat = 1.0
        """Factor of the mean squared error. With 0, this term is not computed."""
        l1_weight: NonNegativeFloat = 0.0
        """Factor of the mean absolute error (TokenGS 2026.6: 0.8, without MSE). With 0, this term
        is not computed."""
        ssim_weight: NonNegativeFloat = 0.2
        """Factor of (1 - SSIM) / 2. With 0, this term is not computed."""
        padding: Padding = "same"
        """Rule for image borders in SSIM. "same" pads images with zeros, as the TokenGS and LocusGS
        releases do. "valid" uses only windows that lie inside the image."""

    config: Config

    @classmethod
    def problems(cls, config: Config, context: RecipeContext) -> Iterable[Problem]:
        if config.ssim_weight and config.padding == "valid":
            yield from too_small(context, WINDOW, "padding", "SSIM without padding")

    def term(
        self, prediction: LayerPrediction, rendering: Rendering, target: Views, inputs: Views
    ) -> dict[str, Tensor]:
        """Return the weighted terms `mse`, `l1` and `ssim`, without those whose factor is 0.

        Raises ValueError for images too small for SSIM.
        """
        config = self.config
        images = (rendering.rgb, target.images)
        terms = {}
        if config.mse_weight:
            terms["mse"] = config.mse_weight * mean_squared_error(*images)
        if config.l1_weight:
            terms["l1"] = config.l1_weight * F.l1_loss(*images)
        if config.ssim_weight:
            # SSIM lies between -1 and 1, so this term lies between 0 and its weight.
            terms["ssim"] = config.ssim_weight * (1 - mean_ssim(*images, config.padding)) / 2
        return terms


class Opacity(Loss):
    """Opacity loss, the mean of -ln(opacity + eps) (TokenGS release, weight 0 in its recipes)."""

    name = "opacity"
    renderings = "none"

    class Config(Loss.Config):
        weight: NonNegativeFloat = 0.1
        """Factor of this loss in the objective. With 0, the loss is not computed."""
        eps: PositiveFloat = 1e-6
        """Number added to the opacity, so that the logarithm stays finite (TokenGS release)."""

    config: Config

    def term(
        self, prediction: LayerPrediction, rendering: Rendering, target: Views, inputs: Views
    ) -> Tensor:
        # The logarithm of a half precision number near 0 jumps.
        opacities = at_least_float32(prediction.gaussians.opacities)
        return -mean_of_gaussians((opacities + self.config.eps).log(), prediction)


class Mask(Loss):
    """Mask loss, the mean of (alpha - mask)^2 over pixels, with alpha of the rendering.

    The TokenGS and LocusGS releases have this loss; their published recipes do not use it.
    """

    name = "mask"
    renderings = "each"

    class Config(Loss.Config):
        weight: NonNegativeFloat = 0.5
        """Factor of this loss in the objective. With 0, the loss is not computed."""

    config: Config

    def term(
        self, prediction: LayerPrediction, rendering: Rendering, target: Views, inputs: Views
    ) -> Tensor:
        """Return the mask loss; raise ValueError if the target views have no masks."""
        if target.masks is None:
            raise ValueError(
                "the loss qgs/mask needs views with masks, but these target views have none; "
                "choose data with masks, or remove the loss from the recipe"
            )
        return mean_squared_error(rendering.alpha, target.masks)


def too_small(context: RecipeContext, side: int, option: str, measure: str) -> Iterator[Problem]:
    """Yield a problem of `option` if the data's images have a side shorter than `side` pixels.

    measure: name of the loss or metric that needs images of this size, for the message.
    """
    if context.image_size and min(context.image_size) < side:
        given = "{} x {} (H x W)".format(*context.image_size)
        reason = f"{measure} needs images of at least {side} pixels a side, but they are {given}"
        yield Problem(option, reason, "raise data.image_size, or remove this option")


mean_squared_error = full_precision(F.mse_loss)
"""Mean of the squared differences of two tensors, over all elements."""


def mean_of_gaussians(values: Tensor, prediction: LayerPrediction) -> Tensor:
    """Average values (B, G) over the G Gaussians of a scene, then over B scenes, to a 0-d tensor.

    Gaussians of padding queries (`QueryState.mask`) do not count.
    """
    values = at_least_float32(values)
    mask = prediction.state.mask
    if mask is None:
        return values.mean()
    # Scenes count alike, however many queries they have.
    there = mask.repeat_interleave(values.shape[1] // mask.shape[1], 1)
    return ((values * there).sum(1) / there.sum(1).clamp_min(1)).mean()
