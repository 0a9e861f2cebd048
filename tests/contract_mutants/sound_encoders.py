"""An encoder whose tokens see far beyond their patches."""

from __future__ import annotations

from typing import ClassVar

from torch import Tensor, nn

from qgs.components import MultiViewViT
from qgs.contracts import ModelDims


class SeesFar(MultiViewViT):
    """Convolutions over 19 pixels, before patches of 8 are cut."""

    name: ClassVar[str] = "sees_far"

    def __init__(self, config: MultiViewViT.Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        layers = [(3, 16), (16, 16), (16, 3)]
        self.stem = nn.Sequential(
            *(nn.Sequential(nn.Conv2d(i, o, 7, padding=3), nn.Tanh()) for i, o in layers)
        )

    def embed(self, images: Tensor, plucker: Tensor) -> Tensor:
        seen = self.stem(images.flatten(0, 1)).unflatten(0, images.shape[:2])
        return super().embed(seen, plucker)
