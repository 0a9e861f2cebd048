"""State fields of an ellipsoidal anchor besides its centre: a rotation and three raw radii.

Rotations are quaternions w x y z. Raw radii are any numbers; `support_radius` maps them to radii.
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
"""Field of rotations of the anchors' axes (B, N, 4)."""


def radii_field(options: RadiusOptions) -> Fields:
    """Return the state field of raw radii (B, N, 3), one for each axis of the anchor.

    As in LocusGS, the field's `encoding` tells the values of `radius_bound` and `radius_min`.
    """
    (scalar,) = radius_field(options).values()
    return {RAW_RADII: FieldSpec((3,), encoding=scalar.encoding)}


def shape_fields(options: RadiusOptions) -> Fields:
    """Return the state fields of anchor rotations (B, N, 4) and raw radii (B, N, 3)."""
    return {**ROTATION_FIELD, **radii_field(options)}


@full_precision
def anchor_rotation(quats: Tensor) -> Tensor:
    """Return rotation matrices (..., 3, 3), anchor to world, from quaternions (..., 4).

    Quaternions w x y z may have any length. A quaternion of length 0 gives the identity.
    """
    return quat_to_matrix(unit(quats))


def anchor_axes(state: QueryState, options: RadiusOptions) -> Tensor:
    """Return the semi-axes of each anchor's ellipsoid as columns (B, N, 3, 3), world frame."""
    radii = support_radius(state[RAW_RADII], options)
    return anchor_rotation(state[ROTATION]) * radii[..., None, :]


@full_precision
def turned(quats: Tensor, turn: Tensor) -> Tensor:
    """Turn `quats` (..., 4) about world axes by `turn` (..., 3), and return unit quaternions.

    The rotation has the axis `turn` and the angle 2 atan(|turn| / 2). Small angles are about |turn|
    radians; 180 degrees are never reached. So turn / 2 is the Gibbs vector of the rotation (Cayley
    transform).
    """
    small = torch.cat([torch.ones_like(turn[..., :1]), turn / 2], -1)
    return F.normalize(quat_product(F.normalize(small, dim=-1), quats), dim=-1)
