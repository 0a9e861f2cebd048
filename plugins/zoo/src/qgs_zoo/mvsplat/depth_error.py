"""`mvsplat/depth_error`: how far rendered depths are from true ones."""

from torch import Tensor

from qgs.contracts import Column, Metric, MetricInput


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
