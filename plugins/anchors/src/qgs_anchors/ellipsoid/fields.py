"""The shape of an anchor as state fields: a rotation and three raw radii beside its centre.

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
    """Raw radii (B, N, 3) along the axes of the anchor, with the encoding of LocusGS's one."""
    (scalar,) = radius_field(options).values()
    return {RAW_RADII: FieldSpec((3,), encoding=scalar.encoding)}


def shape_fields(options: RadiusOptions) -> Fields:
    """Rotation and raw radii."""
    return {**ROTATION_FIELD, **radii_field(options)}


@full_precision
def anchor_rotation(quats: Tensor) -> Tensor:
    """R (..., 3, 3), anchor to world, of quaternions (..., 4) of any length; 0 is the identity."""
    return quat_to_matrix(unit(quats))


def anchor_axes(state: QueryState, options: RadiusOptions) -> Tensor:
    """R diag(r) (B, N, 3, 3): the semi-axes of each anchor as columns, world units."""
    radii = support_radius(state[RAW_RADII], options)
    return anchor_rotation(state[ROTATION]) * radii[..., None, :]


@full_precision
def turned(quats: Tensor, turn: Tensor) -> Tensor:
    """Unit quaternions (..., 4) of `quats` turned about world axes by `turn` (..., 3).

    turn / 2 is the Gibbs vector of the rotation: it turns about `turn` by 2 atan(|turn| / 2), which
    is |turn| radians while that is small and never half a turn (Cayley transform).
    """
    small = torch.cat([torch.ones_like(turn[..., :1]), turn / 2], -1)
    return F.normalize(quat_product(F.normalize(small, dim=-1), quats), dim=-1)
