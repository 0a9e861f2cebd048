"""The shape of an anchor as state fields: a rotation and three raw radii beside its centre."""

from qgs_locus.fields import RadiusOptions, radius_field, support_radius
from torch import Tensor

from qgs.contracts import Fields, FieldSpec
from qgs.geometry.precision import full_precision
from qgs.geometry.transforms import quat_to_matrix
from qgs.types import QueryState
from qgs_anchors.ellipsoid.rotations import unit_quats

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
    return quat_to_matrix(unit_quats(quats))


def anchor_axes(state: QueryState, options: RadiusOptions) -> Tensor:
    """R diag(r) (B, N, 3, 3): the semi-axes of each anchor as columns, world units."""
    radii = support_radius(state[RAW_RADII], options)
    return anchor_rotation(state[ROTATION]) * radii[..., None, :]
