"""`qgs/opacity`, `qgs/mask`: Gaussians become opaque, alpha becomes the mask (TokenGS release)."""

from pydantic import Field
from torch import Tensor

from qgs.contracts import Loss
from qgs.geometry.precision import at_least_float32
from qgs.losses.photometric import mean_squared_error
from qgs.types import LayerPrediction, Rendering, Views


class Opacity(Loss):
    """Mean over Gaussians of -ln(opacity + eps) (TokenGS release, weight 0 in its recipes)."""

    name = "opacity"
    renderings = "none"

    class Config(Loss.Config):
        weight: float = Field(default=0.1, ge=0)
        """Factor of the term in the objective."""
        eps: float = Field(default=1e-6, gt=0)
        """Added to the opacity, so that the logarithm is finite (TokenGS release)."""

    config: Config

    def term(
        self, prediction: LayerPrediction, rendering: Rendering, target: Views, inputs: Views
    ) -> Tensor:
        # The logarithm of a half precision number near 0 jumps.
        opacities = at_least_float32(prediction.gaussians.opacities)
        return -mean_of_gaussians((opacities + self.config.eps).log(), prediction)


class Mask(Loss):
    """Mean of (alpha - mask)^2 over all pixels (TokenGS, LocusGS releases; no published recipe)."""

    name = "mask"
    renderings = "each"

    class Config(Loss.Config):
        weight: float = Field(default=0.5, ge=0)
        """Factor of the term in the objective."""

    config: Config

    def term(
        self, prediction: LayerPrediction, rendering: Rendering, target: Views, inputs: Views
    ) -> Tensor:
        """Raises ValueError for views without masks."""
        if target.masks is None:
            raise ValueError(
                "the loss qgs/mask needs views with masks and these have none; "
                "choose data with masks, or take the loss out of the recipe"
            )
        return mean_squared_error(rendering.alpha, target.masks)


def mean_of_gaussians(values: Tensor, prediction: LayerPrediction) -> Tensor:
    """Values (B, G), averaged over the Gaussians of queries that exist, then over scenes; 0-d."""
    values = at_least_float32(values)
    mask = prediction.state.mask
    if mask is None:
        return values.mean()
    # Scenes count alike, however many queries they have.
    there = mask.repeat_interleave(values.shape[1] // mask.shape[1], 1)
    return ((values * there).sum(1) / there.sum(1).clamp_min(1)).mean()
