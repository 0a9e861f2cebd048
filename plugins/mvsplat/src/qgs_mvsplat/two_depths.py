"""Supervision of both of DepthSplat's depths: Gaussians of all other numbers at either of them.

`mvsplat/two_depths` starts queries with both, `mvsplat/exchange` is a decoder layer that exchanges
them, so that layer 1 has the coarse and layer 2 the final depth, and `mvsplat/decayed` weighs them.
"""

from collections.abc import Mapping

import torch
from pydantic import Field

from qgs.components.supervision import LayerSupervision
from qgs.contracts import DecoderLayer, Fields, FieldSpec, memory_fields
from qgs.types import ImageMemory, QueryState, Views
from qgs_mvsplat.pixels import PixelQueries, predicted

OTHER = "mvsplat.other_depth"
OTHER_FIELD: Fields = {OTHER: FieldSpec((1,), encoding="logarithm of a depth, world units")}
"""The depth that the features of a query do not have at this layer."""


class TwoDepths(PixelQueries):
    """`mvsplat/pixels` of an encoder with `coarse_depth`: the coarse one goes into a field."""

    name = "two_depths"

    @classmethod
    def fields_read(cls, config: PixelQueries.Config) -> Fields:
        channels = predicted(config.sh_degree).shape[0] + 1
        return {"memory.features": FieldSpec((channels,)), **memory_fields("grid")}

    @classmethod
    def fields_written(cls, config: PixelQueries.Config) -> Fields:
        return {**super().fields_written(config), **OTHER_FIELD}

    def forward(self, memory: ImageMemory, views: Views) -> QueryState:
        numbers, coarse = memory.features[..., :-1], memory.features[..., -1:]
        state = super().forward(memory.replace(features=numbers), views)
        return state.replace(fields={OTHER: coarse})


class Exchange(DecoderLayer):
    """Exchanges the depth in the features, channel 0, with the one in the field."""

    name = "exchange"
    reads = writes = OTHER_FIELD
    reads_layer_scale = False

    def forward(self, state: QueryState, memory: ImageMemory) -> tuple[QueryState, ImageMemory]:
        """The memory is passed on."""
        own, rest = state.features[..., :1], state.features[..., 1:]
        features = torch.cat([state[OTHER].to(own), rest], -1)
        return state.replace(features=features, fields={OTHER: own.to(state[OTHER])}), memory


class DecayedSupervision(LayerSupervision):
    """The last of S supervised layers weighs 1, each before `decay` times the next, over their sum.

    The released code does not divide by the sum, 1.9 for two depths: Adam does not see a factor of
    all gradients, but clipping does.
    """

    name = "decayed"

    class Config(LayerSupervision.Config):
        decay: float = Field(default=0.9, gt=0, le=1)
        """Weight of a layer over that of the next one."""

    config: Config

    def weights(self) -> Mapping[int, float]:
        layers = self.config.layers
        each = [self.config.decay**n for n in range(len(layers) - 1, -1, -1)]
        return {layer: weight / sum(each) for layer, weight in zip(layers, each, strict=True)}
