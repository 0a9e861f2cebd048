"""`c3g/vggt_features`: image tokens of VGGT, with code and weights that the user installs.

Code and weights have their own licences, so this package neither contains nor downloads them. The
module `vggt.models.aggregator.Aggregator()` must take images (B, V, 3, H, W) and return two things:
a list of tensors (B, V, P, 2048), one for each layer, with the P tokens of each view; and the index
of the first of these tokens that belongs to a patch.
"""

from importlib import import_module
from typing import Any, Literal

from einops import rearrange
from pydantic import Field
from torch import nn

from qgs.contracts import MissingExtraError, ModelDims, PatchEncoder, memory_fields
from qgs.types import ImageMemory, Views
from qgs_zoo.parts import weight_file

WIDTH = 2048
"""Width of a token of the last layer (VGGT-1B)."""

MODULE = "vggt.models.aggregator"
"""Module of VGGT's code. It is not on PyPI, so no extra can install it."""

PREFIX = "aggregator."
"""Prefix of the names of weights to read. The file also has weights of other parts of VGGT."""


class VggtFeatures(PatchEncoder):
    """Encoder that returns the patch tokens of VGGT's last layer (C3G).

    VGGT's tokens for cameras and registers are left out. The encoder reads images but no cameras.
    If the model's width is not 2048, a linear layer maps tokens to this width. A checkpoint
    contains all weights, so only a new model needs the weight file.
    """

    name = "vggt_features"
    writes = memory_fields("features", "grid")
    # VGGT marks the first view.
    ordered_views = True
    reads_cameras = False

    class Config(PatchEncoder.Config):
        patch_size: Literal[14] = 14
        """Side of a patch in pixels. VGGT supports 14 only."""
        weights: str = Field(min_length=1)
        """File of VGGT's weights: model.safetensors or model.pt."""
        images: Literal["signed", "unit"] = "signed"
        """Range of the images that VGGT gets. `signed`: from -1 to 1, as in the C3G release.
        `unit`: from 0 to 1, as in VGGT's training."""

    config: Config

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        try:
            aggregator: Any = import_module(MODULE).Aggregator
        except ImportError as error:
            raise MissingExtraError(
                "the encoder c3g/vggt_features needs VGGT's code, which has its own licence: "
                "pip install git+https://github.com/facebookresearch/vggt; or use "
                "another encoder, such as qgs/multiview_vit"
            ) from error
        self.aggregator = aggregator()
        # With the width of VGGT there is no layer, so that tokens stay unchanged.
        own = dims.width == WIDTH
        self.proj = nn.Identity() if own else nn.Linear(WIDTH, dims.width)

    def forward(self, views: Views) -> ImageMemory:
        """Return the features (B, M, D) of all patches, and the grid that the patches form."""
        grid = self.grid(views)
        images = views.images * 2 - 1 if self.config.images == "signed" else views.images
        outputs, first = self.aggregator(images)
        # Tokens before `first` belong to cameras and registers.
        tokens_BMC = rearrange(outputs[-1][:, :, first:], "b v p c -> b (v p) c")
        return ImageMemory(features=self.proj(tokens_BMC), grid=grid)

    def load_pretrained(self) -> None:
        remedy = (
            "download VGGT-1B's model.safetensors, which has its own licence, and set the option "
            "`weights` to the file"
        )
        with weight_file(self.config.weights, remedy) as weights:
            # The file holds all of VGGT.
            own = {n.removeprefix(PREFIX): x for n, x in weights.items() if n.startswith(PREFIX)}
            self.aggregator.load_state_dict(own)
