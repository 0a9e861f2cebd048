"""What is measured on Gaussians alone: how far those of one query scatter."""

from collections.abc import Mapping

import torch
from torch import Tensor

from qgs.contracts import Column, Metric, MetricInput
from qgs.precision import full_precision

OPACITY_USED = 1 / 255
"""A Gaussian of lower opacity is never drawn: renderers skip alpha below 1/255."""


class Dispersion(Metric):
    """Dispersion, distance of Gaussians to the centroid of their query's: small where a query is
    one place. A few far ones rule its mean, which LocusGS publishes, not its median.
    """

    name = "dispersion"
    definition = "distance of Gaussians to their token's centroid, world units"
    needs = ("gaussians",)

    def columns(self) -> Mapping[str, Column]:
        """Both in world units."""
        # Papers print the mean, which a few far Gaussians rule; the median shows the rest.
        headings = {"mean": "dispersion mean", "median": "dispersion med."}
        return {key: Column(h, "lower", unit="world units") for key, h in headings.items()}

    def forward(self, given: MetricInput) -> Mapping[str, Tensor]:
        """Distances (1, G), and their median (1,)."""
        assert given.gaussians is not None
        distances = token_dispersion(given.gaussians.means, given.gaussians_per_query)
        return {"mean": distances, "median": torch.quantile(distances, 0.5, dim=-1)}


@full_precision
def token_dispersion(means: Tensor, gaussians_per_query: int) -> Tensor:
    """Distance of each Gaussian to the centroid of its query's, world units.

    means: (B, N * K, 3) ordered query by query -> (B, N * K).
    Raises ValueError when K does not divide the number of Gaussians.
    """
    if means.shape[-2] % gaussians_per_query:
        raise ValueError(
            f"{means.shape[-2]} Gaussians cannot be shared out to queries of {gaussians_per_query}"
        )
    tokens = means.unflatten(-2, (-1, gaussians_per_query))
    return (tokens - tokens.mean(-2, keepdim=True)).norm(dim=-1).flatten(-2)
