"""`dinov2/multiview_vit`: DINOv2's tokens and rays, then ViT blocks over all views together."""

import torch.nn.functional as F
from pydantic import Field
from torch import Tensor, nn

from qgs.contracts import ModelDims
from qgs.tokengs import NORM_EPS
from qgs.tokengs.encoder import MultiViewViT
from qgs_zoo.dinov2.vit import PATCH, DinoV2, VitConfig


class Tokens(nn.Module):
    """Normalised images (X, 3, H, W) to tokens (X, H/P*W/P, D): DINOv2, linear, LayerNorm."""

    def __init__(self, config: VitConfig, width: int, patch_size: int) -> None:
        super().__init__()
        self.patch_size = patch_size
        self.last = config.depth - 1
        self.vit = DinoV2(config.width, config.depth, config.heads)
        self.proj = nn.Linear(config.width, width)
        self.norm = nn.LayerNorm(width, NORM_EPS)

    def forward(self, images_X3HW: Tensor) -> Tensor:
        # Each patch of the model becomes 14 x 14 pixels, so that tokens of both share a grid.
        size = [side // self.patch_size * PATCH for side in images_X3HW.shape[-2:]]
        if list(images_X3HW.shape[-2:]) != size:
            images_X3HW = F.interpolate(images_X3HW, size, mode="bilinear", antialias=True)
        return self.norm(self.proj(self.vit(images_X3HW, (self.last,))[0]))


class DinoMultiViewViT(MultiViewViT):
    """`qgs/multiview_vit` whose colours are embedded by a pretrained DINOv2, one photo at a time.

    Photos are resized so that a patch has DINOv2's 14 x 14 pixels: patches of 16 of 256 x 256
    photos are those of 224 x 224 ones.
    """

    name = "multiview_vit"

    class Config(MultiViewViT.Config):
        patch_size: int = Field(default=16, ge=1)
        """Side of a patch, pixels of the photos; must divide both sides of the image."""
        vit: VitConfig
        """DINOv2's sizes and weights; `{}` for a ViT-S that starts from random numbers."""

    config: Config

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.rgb_embedding = Tokens(config.vit, dims.width, config.patch_size)

    def load_pretrained(self) -> None:
        self.rgb_embedding.vit.load(self.config.vit.weights)
