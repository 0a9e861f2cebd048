"""Means over Gaussians, of which those of places without a query are none."""

from torch import Tensor

from qgs.geometry.precision import at_least_float32
from qgs.types import LayerPrediction


def mean_of_gaussians(values: Tensor, prediction: LayerPrediction) -> Tensor:
    """Values (B, G), averaged over the Gaussians of queries that exist, then over scenes; 0-d."""
    values, mask = at_least_float32(values), prediction.state.mask
    if mask is None:
        return values.mean()
    there = mask.repeat_interleave(values.shape[1] // mask.shape[1], 1)
    return ((values * there).sum(1) / there.sum(1).clamp_min(1)).mean()
