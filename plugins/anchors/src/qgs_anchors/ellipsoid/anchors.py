"""`ellipsoid/anchored`: queries with a 3D anchor, which is a centre with an ellipsoid around it.

LocusGS is the special case of three equal radii: `from_locus` converts its weights.
"""

from collections.abc import Mapping

import torch
import torch.nn.functional as F
from pydantic import PositiveFloat
from qgs_locus.anchors import CentredQueries
from qgs_locus.fields import CENTER, CENTER_FIELD, raw_radius_of
from torch import Tensor, nn

from qgs.contracts import Fields, ModelDims
from qgs.types import QueryState, SpatialSupport
from qgs_anchors.ellipsoid.fields import RAW_RADII, ROTATION, anchor_axes, shape_fields


class EllipsoidQueries(CentredQueries):
    """N learned queries for all scenes: features, anchor centres, rotations, three raw radii."""

    name = "anchored"

    class Config(CentredQueries.Config):
        init_radii: tuple[PositiveFloat, PositiveFloat, PositiveFloat] = (1.0, 1.0, 1.0)
        """Initial radii of each anchor along the axes of the world frame, world units.
        `radius_bound` tells whether `radius_min` is their lower bound or is added to them."""

    config: Config

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        # No rotation at first: with equal radii the model starts as LocusGS does.
        identity = torch.tensor([1.0, 0.0, 0.0, 0.0])
        self.rotation = nn.Parameter(identity.repeat(config.count, 1))
        raw = torch.tensor([*map(raw_radius_of, config.init_radii)])
        self.raw_radii = nn.Parameter(raw.repeat(config.count, 1))

    @classmethod
    def fields_written(cls, config: Config) -> Fields:
        return {**CENTER_FIELD, **shape_fields(config)}

    def decays(self, name: str, parameter: nn.Parameter) -> bool:
        """Return whether weight decay applies to `parameter`: never to rotations.

        Other parameters decay as in the base class. Weight decay of rotations would only change
        lengths of quaternions, which have no effect on results.
        """
        return name != "rotation" and super().decays(name, parameter)

    def shapes(self) -> dict[str, Tensor]:
        """Return unit quaternions (N, 4) and raw radii (N, 3)."""
        # The optimiser changes the meaningless lengths; components get unit quaternions.
        return {ROTATION: F.normalize(self.rotation, dim=-1), RAW_RADII: self.raw_radii}

    def support(self, state: QueryState) -> SpatialSupport:
        """Return the ellipsoid of each anchor."""
        return SpatialSupport(centers=state[CENTER], axes=anchor_axes(state, self.config))


def from_locus(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Convert weights of a LocusGS model to weights of a model with ellipsoidal anchors.

    The new model must have LocusGS's head. Each radius becomes three equal radii, and the converted
    refinement changes all three by equal steps. Rotations are the identity. If the refinement has
    `rotation: false`, the new model computes the same as LocusGS. Weights of the MLP that refines
    rotations are missing, so load the result with `strict=False`. Raises KeyError if the weights
    have no radii.
    """
    converted = {name: _tripled(name, values) for name, values in weights.items()}
    converted["queries.raw_radii"] = converted.pop("queries.raw_radius")
    # A ball has no orientation, so any rotation is right.
    identity = torch.tensor([1.0, 0.0, 0.0, 0.0]).to(weights["queries.raw_radius"])
    converted["queries.rotation"] = identity.repeat(len(weights["queries.raw_radius"]), 1)
    return converted


def _tripled(name: str, values: Tensor) -> Tensor:
    if name == "queries.raw_radius":
        return values.repeat(1, 3)
    # Rows of the last layer are the radii: with equal rows they get equal steps.
    if name.startswith("refinements.0.radius_mlp.fc2."):
        return values.repeat(3, *(1 for _ in values.shape[1:]))
    return values.clone()
