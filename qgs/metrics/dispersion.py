"""The metric `qgs/dispersion`, the spatial scatter of each query's Gaussians."""

from collections.abc import Mapping

from torch import Tensor

from qgs.contracts import Column, Metric, MetricInput
from qgs.precision import full_precision

OPACITY_USED = 1 / 255
"""Opacity below which a Gaussian is never rendered: renderers skip alpha below 1/255."""


class Dispersion(Metric):
    """Distance of Gaussians to the centroid of all Gaussians of the same query.

    A small value means that each query covers one region. LocusGS publishes the mean. A few far
    Gaussians change the mean much, but not the median.
    """

    name = "dispersion"
    definition = "distance of Gaussians to their token's centroid, world units"
    needs = ("gaussians",)

    def columns(self) -> Mapping[str, Column]:
        """Return a column for the mean distance and one for the median, both in world units."""
        # Papers print the mean, which depends on a few far Gaussians; the median shows the rest.
        headings = {"mean": "dispersion mean", "median": "dispersion med."}
        return {key: Column(h, "lower", unit="world units") for key, h in headings.items()}

    def forward(self, given: MetricInput) -> Mapping[str, Tensor]:
        """Return "mean", the distances (1, G), and "median", their median (1,).

        The mean of the distances is taken later, as for the values of every metric.
        """
        assert given.gaussians is not None
        distances = token_dispersion(given.gaussians.means, given.gaussians_per_query)
        return {"mean": distances, "median": distances.quantile(0.5, -1)}


@full_precision
def token_dispersion(means: Tensor, gaussians_per_query: int) -> Tensor:
    """Return the distance of each Gaussian to its query's centroid, in world units.

    means: (B, N * K, 3) for B scenes, N queries and K Gaussians per query, ordered query by query
        -> (B, N * K). Raises ValueError if K does not divide the number of Gaussians.
    """
    if means.shape[-2] % gaussians_per_query:
        raise ValueError(
            f"{means.shape[-2]} Gaussians are no multiple of {gaussians_per_query}, the number of "
            "Gaussians per query"
        )
    tokens = means.unflatten(-2, (-1, gaussians_per_query))
    return (tokens - tokens.mean(-2, keepdim=True)).norm(dim=-1).flatten(-2)
