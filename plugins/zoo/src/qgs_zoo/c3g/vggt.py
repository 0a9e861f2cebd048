"""`c3g/vggt_features`: image tokens of VGGT, whose code and weights the user brings.

Neither is free, so this distribution holds and downloads none of them. What is relied on:
`vggt.models.aggregator.Aggregator()` takes images (B, V, 3, H, W) and returns a list of tokens
(B, V, P, 2048), one for each of its layers, and the index of the first that belongs to a patch.
"""

from collections.abc import Mapping
from importlib import import_module
from typing import Any, Literal

from einops import rearrange
from pydantic import Field
from torch import Tensor, nn

from qgs.contracts import MissingExtraError, ModelDims, PatchEncoder, memory_fields
from qgs.types import ImageMemory, Views
from qgs_zoo.parts import load_weights

WIDTH = 2048
"""Of a token of the last layer (VGGT-1B)."""

MODULE = "vggt.models.aggregator"
"""No distribution of PyPI offers it, so no extra of ours can name one."""

PREFIX = "aggregator."
"""Of the weights that are read, in the file of all of VGGT."""


class VggtFeatures(PatchEncoder):
    """Tokens of VGGT's last layer, without those of cameras and registers (C3G).

    It reads images alone, no cameras. Where the model's width is not 2048, a linear layer leads to
    it. A checkpoint has all weights, so that only a model that starts needs the file.
    """

    name = "vggt_features"
    writes = memory_fields("features", "grid")
    # VGGT marks the first one.
    ordered_views = True
    reads_cameras = False

    class Config(PatchEncoder.Config):
        patch_size: Literal[14] = 14
        """Side of a patch, pixels: VGGT's."""
        weights: str = Field(min_length=1)
        """File of VGGT's weights: its model.safetensors, or model.pt."""
        images: Literal["signed", "unit"] = "signed"
        """What VGGT is given: images in [-1, 1] as in the C3G release, or in [0, 1] ("unit"), as
        VGGT was trained."""

    config: Config

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.aggregator = _aggregator_class()()
        # No layer in between where the width is VGGT's, so that its tokens are seen unchanged.
        own = dims.width == WIDTH
        self.proj = nn.Identity() if own else nn.Linear(WIDTH, dims.width)

    def forward(self, views: Views) -> ImageMemory:
        """Features (B, M, D) of all patches, and their grid."""
        grid = self.grid(views)
        images = views.images * 2 - 1 if self.config.images == "signed" else views.images
        outputs, first = self.aggregator(images)
        # What stands before `first` are tokens of cameras and registers.
        tokens_BMC = rearrange(outputs[-1][:, :, first:], "b v p c -> b (v p) c")
        return ImageMemory(features=self.proj(tokens_BMC), grid=grid)

    def load_pretrained(self) -> None:
        load_weights(
            self.config.weights,
            self._fill,
            "download VGGT-1B's model.safetensors, whose licence is not ours to give, and name it "
            "in the option `weights`",
        )

    def _fill(self, weights: Mapping[str, Tensor]) -> None:
        # The file holds all of VGGT.
        own = {n.removeprefix(PREFIX): x for n, x in weights.items() if n.startswith(PREFIX)}
        self.aggregator.load_state_dict(own)


def _aggregator_class() -> Any:
    try:
        return import_module(MODULE).Aggregator
    except ImportError as error:
        raise MissingExtraError(
            "the encoder c3g/vggt_features needs VGGT's code, which comes with a licence of its "
            "own: pip install git+https://github.com/facebookresearch/vggt; without it, use "
            "another encoder, such as qgs/multiview_vit"
        ) from error
