"""Supervision of both depths of DepthSplat: the same Gaussians, placed at either depth.

The decoder layer `mvsplat/exchange` exchanges the depths: the Gaussians of layer 1 have the coarse
depth, those of layer 2 the final one. `mvsplat/decayed` weighs the layers. `mvsplat/depth_error`
measures depths.
"""

from collections.abc import Mapping, Sequence

import torch
from pydantic import Field
from torch import Tensor

from qgs.contracts import Column, DecoderLayer, Metric, MetricInput
from qgs.tokengs.supervision import LayerSupervision
from qgs.types import ImageMemory, QueryState


class Exchange(DecoderLayer):
    """Decoder layer that exchanges a query's first and last number: its depth and the other one.

    The encoder needs `coarse_depth: true`. An even number of layers ends with the final depth.
    """

    name = "exchange"
    reads_layer_scale = False

    def forward(self, state: QueryState, memory: ImageMemory) -> tuple[QueryState, ImageMemory]:
        """Exchange the numbers, and return the memory unchanged."""
        # The depth in use is first, the other one last.
        own, rest, other = state.features.tensor_split([1, state.features.shape[-1] - 1], -1)
        return state.replace(features=torch.cat([other, rest, own], -1)), memory


class DecayedSupervision(LayerSupervision):
    """Supervision in which each layer weighs `decay` times the next; weights add up to 1.

    The released code does not divide by the sum, which is 1.9 for two depths. A common factor of
    all gradients does not matter to Adam, but it does to clipping.
    """

    name = "decayed"

    class Config(LayerSupervision.Config):
        decay: float = Field(default=0.9, gt=0, le=1)
        """Weight of a layer divided by the weight of the next one."""

    config: Config

    def weights(self, rounds: Sequence[int] = ()) -> Mapping[int, float]:
        layers = (*self.config.layers, *rounds)
        each = [self.config.decay**n for n in range(len(layers) - 1, -1, -1)]
        return {layer: weight / sum(each) for layer, weight in zip(layers, each, strict=True)}


class DepthError(Metric):
    """AbsRel: mean of |z - true z| / true z over pixels with a known depth."""

    name = "depth_error"
    definition = "|rendered - true| / true camera-frame z, mean over known pixels of all views"
    needs = ("depth", "true_depth")
    column = Column("AbsRel", "lower")

    def forward(self, given: MetricInput) -> Tensor:
        """Return one number for each pixel with a true depth; 1 if nothing is rendered there."""
        assert given.depth is not None
        assert given.true_depth is not None
        # Zero means that there is no measurement.
        known = given.true_depth > 0
        true = given.true_depth[known]
        return (given.depth[known] - true).abs() / true
