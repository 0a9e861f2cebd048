"""`qgs/lpips`: how different rendered and true images look to VGG-16, see `qgs.perceptual`."""

from collections.abc import Iterable
from typing import ClassVar

from pydantic import Field
from torch import Tensor

from qgs.contracts import ComponentConfig, Loss, MissingExtraError, Problem, RecipeContext
from qgs.losses.photometric import too_small
from qgs.perceptual import SMALLEST_SIDE, PerceptualDistance
from qgs.types import LayerPrediction, Rendering, Views


class LpipsLoss(Loss):
    """Mean LPIPS of the views, of VGG-16 (TokenGS 2026.6); nothing is downloaded."""

    name: ClassVar[str] = "lpips"
    scheduled: ClassVar[frozenset[str]] = frozenset({"weight"})
    renderings = "each"

    class Config(ComponentConfig):
        weight: float = Field(default=0.5, ge=0)
        """Factor of the term in the objective."""
        weights: str | None = None
        """File of VGG-16 weights (safetensors, or torchvision's vgg16-397923af.pth); null takes
        the one in torch's cache."""

    config: Config

    def __init__(self, config: Config) -> None:
        super().__init__(config)
        self.network = PerceptualDistance(config.weights)

    @classmethod
    def problems(cls, config: Config, context: RecipeContext) -> Iterable[Problem]:
        yield from too_small(context, SMALLEST_SIDE, "", "LPIPS")

    def forward(
        self, prediction: LayerPrediction, rendering: Rendering, target: Views, inputs: Views
    ) -> dict[str, Tensor]:
        """One term, `lpips`.

        Raises MissingExtraError without the weights, ValueError for images below 16 pixels a side.
        """
        if self.network.unavailable:
            raise MissingExtraError(
                f"the loss qgs/lpips cannot be used: {self.network.unavailable}"
            )
        images, truth = rendering.rgb.flatten(0, 1), target.images.flatten(0, 1)
        return {"lpips": self.config.weight * self.network(images, truth).mean()}
