"""State fields of an anchor's shape: a rotation and three raw radii, beside its centre.

Rotations are quaternions w x y z.
"""

import torch
import torch.nn.functional as F
from qgs_locus.fields import RadiusOptions, radius_field, support_radius
from torch import Tensor

from qgs.contracts import Fields, FieldSpec
from qgs.geometry.transforms import quat_product, quat_to_matrix, unit
from qgs.precision import full_precision
from qgs.types import QueryState

ROTATION = "ellipsoid.rotation"
RAW_RADII = "ellipsoid.raw_radii"

ROTATION_FIELD: Fields = {
    ROTATION: FieldSpec((4,), frame="world", encoding="unit quaternion w x y z, anchor to world")
}
"""Rotation R of the anchor's axes (B, N, 4)."""


def radii_field(options: RadiusOptions) -> Fields:
    """Return the field of raw radii (B, N, 3) along the anchor's axes, encoded as in LocusGS."""
    (scalar,) = radius_field(options).values()
    return {RAW_RADII: FieldSpec((3,), encoding=scalar.encoding)}


def shape_fields(options: RadiusOptions) -> Fields:
    """Return the fields of rotation and raw radii."""
    return {**ROTATION_FIELD, **radii_field(options)}


@full_precision
def anchor_rotation(quats: Tensor) -> Tensor:
    """Return R (..., 3, 3), anchor to world, of quaternions (..., 4) of any length.

    A quaternion of length 0 gives the identity.
    """
    return quat_to_matrix(unit(quats))


def anchor_axes(state: QueryState, options: RadiusOptions) -> Tensor:
    """Return R diag(r) (B, N, 3, 3): the semi-axes of each anchor as columns, world units."""
    radii = support_radius(state[RAW_RADII], options)
    return anchor_rotation(state[ROTATION]) * radii[..., None, :]


@full_precision
def turned(quats: Tensor, turn: Tensor) -> Tensor:
    """Turn `quats` about world axes by `turn` (..., 3), and return unit quaternions (..., 4).

    turn / 2 is the Gibbs vector of the rotation (Cayley transform). Its axis is `turn`, its angle
    2 atan(|turn| / 2). Small angles are about |turn| radians; half a turn is never reached.
    """
    small = torch.cat([torch.ones_like(turn[..., :1]), turn / 2], -1)
    return F.normalize(quat_product(F.normalize(small, dim=-1), quats), dim=-1)
