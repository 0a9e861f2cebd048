"""Supervision of DepthSplat's two depths: the Gaussians are rendered at coarse and final depth.

With two decoder layers `mvsplat/exchange`, the Gaussians of layer 1 have the coarse depth, and the
Gaussians of layer 2 the final depth. `mvsplat/decayed` sets the weights of the layers in the
objective. The metric `mvsplat/depth_error` measures errors of depth.
"""

from collections.abc import Mapping, Sequence

import torch
from pydantic import Field
from torch import Tensor

from qgs.contracts import Column, DecoderLayer, Metric, MetricInput
from qgs.tokengs.supervision import LayerSupervision
from qgs.types import ImageMemory, QueryState


class Exchange(DecoderLayer):
    """Decoder layer that swaps a query's first and last feature: its final and its coarse depth.

    The first feature is the depth at which the Gaussian is placed. The encoder needs `coarse_depth:
    true`. With an even number of these layers, the last layer places Gaussians at the final depth.
    """

    name = "exchange"
    reads_layer_scale = False

    def forward(self, state: QueryState, memory: ImageMemory) -> tuple[QueryState, ImageMemory]:
        """Swap the first and the last feature of each query; return the memory unchanged."""
        # The depth in use is first, the other one last.
        own, rest, other = state.features.tensor_split([1, state.features.shape[-1] - 1], -1)
        return state.replace(features=torch.cat([other, rest, own], -1)), memory


class DecayedSupervision(LayerSupervision):
    """Supervision in which the weight of each layer is `decay` times that of the next layer.

    Weights add up to 1. In the released code, they add up to 1.9 for two depths. This factor 1.9 of
    all gradients does not affect Adam, but it affects gradient clipping.
    """

    name = "decayed"

    class Config(LayerSupervision.Config):
        decay: float = Field(default=0.9, gt=0, le=1)
        """Weight of a supervised layer, divided by the weight of the next supervised layer."""

    config: Config

    def weights(self, rounds: Sequence[int] = ()) -> Mapping[int, float]:
        layers = super().weights(rounds)
        each = [self.config.decay**n for n in range(len(layers) - 1, -1, -1)]
        return {layer: weight / sum(each) for layer, weight in zip(layers, each, strict=True)}


class DepthError(Metric):
    """AbsRel: mean of |z - true z| / true z over pixels with a known true depth z."""

    name = "depth_error"
    definition = "|rendered - true| / true camera-frame z, mean over known pixels of all views"
    needs = ("depth", "true_depth")
    column = Column("AbsRel", "lower")

    def forward(self, given: MetricInput) -> Tensor:
        """Return |z - true z| / true z of all pixels with a known true depth, as a 1-d tensor.

        z is the rendered depth. A pixel where nothing is rendered gives 1.
        """
        assert given.depth is not None
        assert given.true_depth is not None
        # Zero means that there is no measurement.
        known = given.true_depth > 0
        true = given.true_depth[known]
        return (given.depth[known] - true).abs() / true
