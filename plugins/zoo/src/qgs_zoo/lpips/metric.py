"""`lpips/vgg16` in slot `metrics`: LPIPS of each view."""

import torch
from torch import Tensor

from qgs.contracts import Column, ComponentConfig, Metric, MetricInput
from qgs_zoo.lpips.network import PerceptualDistance


class Lpips(Metric):
    """LPIPS, distance of each view to the truth in features of VGG-16; nothing is downloaded."""

    name = "vgg16"
    definition = "VGG-16, version 0.1, images in [-1, 1]"
    not_in_protocol = frozenset({"weights"})
    column = Column("LPIPS", "lower")

    class Config(ComponentConfig):
        """Options of LPIPS."""

        weights: str | None = None
        """File of VGG-16 weights (safetensors, or torchvision's vgg16-397923af.pth); null takes
        the one in torch's cache."""

    config: Config

    def __init__(self, config: Config) -> None:
        super().__init__(config)
        self.network = PerceptualDistance()

    def load_pretrained(self) -> None:
        """See `Component`."""
        self.network.load(self.config.weights)

    def forward(self, given: MetricInput) -> Tensor:
        """(1, T). Raises ValueError when a side is shorter than 16 pixels."""
        return self.distance(given.images, given.targets.images)

    @torch.no_grad()
    def distance(self, images: Tensor, truth: Tensor) -> Tensor:
        """LPIPS of images (..., 3, H, W), clipped to [0, 1] -> (...), 0 for equal ones."""
        pairs = zip(*(x.clamp(0, 1).flatten(0, -4).split(1) for x in (images, truth)), strict=True)
        return torch.cat([self.network(*pair) for pair in pairs]).reshape(images.shape[:-3])
