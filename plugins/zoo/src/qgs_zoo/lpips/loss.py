"""`lpips/vgg16` in slot `losses`: how different rendered and true images look to VGG-16."""

from collections.abc import Iterable

from pydantic import Field
from torch import Tensor

from qgs.contracts import Loss, Problem, RecipeContext
from qgs.losses.photometric import too_small
from qgs.types import LayerPrediction, Rendering, Views
from qgs_zoo.lpips.network import SMALLEST_SIDE, PerceptualDistance


class LpipsLoss(Loss):
    """Mean LPIPS of the views, of VGG-16 (TokenGS 2026.6); nothing is downloaded."""

    name = "vgg16"
    renderings = "each"

    class Config(Loss.Config):
        weight: float = Field(default=0.5, ge=0)
        """Factor of the term in the objective."""
        weights: str | None = None
        """File of VGG-16 weights (safetensors, or torchvision's vgg16-397923af.pth); null takes
        the one in torch's cache."""

    config: Config

    def __init__(self, config: Config) -> None:
        super().__init__(config)
        self.network = PerceptualDistance()

    def load_pretrained(self) -> None:
        self.network.load(self.config.weights)

    @classmethod
    def problems(cls, config: Config, context: RecipeContext) -> Iterable[Problem]:
        yield from too_small(context, SMALLEST_SIDE, "", "LPIPS")

    def term(
        self, prediction: LayerPrediction, rendering: Rendering, target: Views, inputs: Views
    ) -> Tensor:
        """Raises ValueError for images below 16 pixels a side."""
        images = rendering.rgb.flatten(0, 1)
        truth = target.images.flatten(0, 1)
        return self.network(images, truth).mean()
