"""Supervision of both of DepthSplat's depths: Gaussians of all other numbers at either of them.

`mvsplat/exchange` is a decoder layer that exchanges the depths, so that layer 1 has the coarse and
layer 2 the final depth; `mvsplat/decayed` weighs them. `mvsplat/depth_error` measures depths.
"""

from collections.abc import Mapping, Sequence

import torch
from pydantic import Field
from torch import Tensor

from qgs.contracts import Column, DecoderLayer, Metric, MetricInput
from qgs.tokengs.supervision import LayerSupervision
from qgs.types import ImageMemory, QueryState


class Exchange(DecoderLayer):
    """Exchanges the first and the last number of a query: its depth and the other one.

    The encoder gives both with `coarse_depth`. An even number of layers ends with the final depth.
    """

    name = "exchange"
    reads_layer_scale = False

    def forward(self, state: QueryState, memory: ImageMemory) -> tuple[QueryState, ImageMemory]:
        """The memory is passed on."""
        # The depth in use stands first, the other one last.
        own, rest, other = state.features.tensor_split([1, state.features.shape[-1] - 1], -1)
        return state.replace(features=torch.cat([other, rest, own], -1)), memory


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

    def weights(self, rounds: Sequence[int] = ()) -> Mapping[int, float]:
        layers = (*self.config.layers, *rounds)
        each = [self.config.decay**n for n in range(len(layers) - 1, -1, -1)]
        return {layer: weight / sum(each) for layer, weight in zip(layers, each, strict=True)}


class DepthError(Metric):
    """AbsRel, mean of |z - true z| / true z over pixels whose depth is known: 0 is the surface."""

    name = "depth_error"
    definition = "|rendered - true| / true camera-frame z, mean over known pixels of all views"
    needs = ("depth", "true_depth")
    column = Column("AbsRel", "lower")

    def forward(self, given: MetricInput) -> Tensor:
        """One number for each pixel with a true depth; where nothing is rendered it is 1."""
        assert given.depth is not None
        assert given.true_depth is not None
        # Zero stands for no measurement.
        known = given.true_depth > 0
        true = given.true_depth[known]
        return (given.depth[known] - true).abs() / true
