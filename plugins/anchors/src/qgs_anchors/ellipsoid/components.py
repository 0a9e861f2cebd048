"""Components with a 3D anchor for each query: a centre with an ellipsoid around it.

LocusGS is the special case of three equal radii: `from_locus` converts its weights. Rotations are
quaternions w x y z. Raw radii are any numbers; `support_radius` maps them to radii.
"""

from collections.abc import Mapping

import torch
import torch.nn.functional as F
from pydantic import PositiveFloat
from qgs_locus.anchors import CentredQueries
from qgs_locus.cross_attention import RayBiasedCrossAttention
from qgs_locus.decoding import RadiusScaledCenters
from qgs_locus.fields import (
    CENTER,
    CENTER_FIELD,
    RadiusOptions,
    radius_field,
    raw_radius_of,
    support_radius,
)
from qgs_locus.kernels.attention_bias import AttentionBias
from qgs_locus.refinement import AnchorRefinement
from torch import Tensor, nn

from qgs.contracts import Fields, FieldSpec, ModelDims
from qgs.geometry.transforms import quat_product, quat_to_matrix, unit
from qgs.precision import full_precision
from qgs.tokengs import GaussianHead
from qgs.types import GaussianAttributes, ImageMemory, QueryState, SpatialSupport
from qgs_anchors.ellipsoid.ray_bias import EllipsoidBias, ray_tokens

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
    small = F.pad(turn / 2, (1, 0), value=1.0)
    return F.normalize(quat_product(F.normalize(small, dim=-1), quats), dim=-1)


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
        self.rotation = nn.Parameter(torch.eye(1, 4).repeat(config.count, 1))
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
    # Rows of the last layer are the radii: with equal rows they get equal steps.
    last = "refinements.0.radius_mlp.fc2."
    converted = {
        name: torch.cat([values] * 3) if name.startswith(last) else values.clone()
        for name, values in weights.items()
    }
    raw_N1 = converted.pop("queries.raw_radius")
    converted["queries.raw_radii"] = raw_N1.repeat(1, 3)
    # A ball has no orientation, so any rotation is right: the identity has w = 1.
    converted["queries.rotation"] = F.pad(torch.ones_like(raw_N1), (0, 3))
    return converted


class EllipsoidCrossAttention(RayBiasedCrossAttention):
    """Attention `locus/ray_biased` with an ellipsoid instead of a ball around the anchor's centre.

    Before the distance from the centre to a ray is computed, the coordinate along each axis of the
    ellipsoid is divided by the radius along this axis. Options mean the same as in
    `locus/ray_biased`; `sigma_sq_min` is the lower bound of (sigma0 r)^2 for the radius r of each
    axis. With `bandwidth: fixed` the ellipsoid has no effect.
    """

    name = "ray_biased"
    raw_radius = RAW_RADII
    fields_of_radius = staticmethod(shape_fields)

    def bias(self, state: QueryState, memory: ImageMemory) -> AttentionBias:
        """Return the bias of attention logits, from anchors in `state` and rays in `memory`."""
        config = self.config
        sigma_sq_BN3 = self.sigma_sq(state)
        # With one bandwidth for all anchors, the bias is that of LocusGS, whose kernels are faster.
        if not isinstance(sigma_sq_BN3, Tensor):
            return super().bias(state, memory)
        # Computed once a pass: all layers read the same rays.
        tokens_B9M = memory.once(
            f"ellipsoid.ray_tokens.{config.direction_eps:g}",
            lambda: ray_tokens(memory["patch_rays"], config.direction_eps),
        )
        place = state[CENTER], anchor_rotation(state[ROTATION]), sigma_sq_BN3
        return EllipsoidBias.of(*place, tokens_B9M, config.bias_min, self.gamma)


class EllipsoidRefinement(AnchorRefinement):
    """Update of anchors as in `locus/refine`, but with three radii, and with a rotation.

    An MLP of the query's features gives the vector by which `turned` rotates the anchor.
    """

    name = "refine"
    parts = ("`center`", "`rotation`", "`radius`")
    field_of_radius = staticmethod(radii_field)

    class Config(AnchorRefinement.Config):
        rotation: bool = True
        """Update anchor rotations after each decoder layer. With false, they stay unchanged."""

    config: Config

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        if config.rotation:
            self.rotation_mlp = self._head(3)

    @classmethod
    def fields_read(cls, config: Config) -> Fields:
        return {**super().fields_read(config), **(ROTATION_FIELD if config.rotation else {})}

    def forward(self, state: QueryState) -> QueryState:
        """Return the state with updated centres, rotations and raw radii."""
        refined = super().forward(state)
        if self.config.rotation:
            # The turn is multiplied from the left, so it is about world axes.
            rotation_BN4 = turned(state[ROTATION], self.rotation_mlp(state.features))
            refined = refined.replace(fields={ROTATION: rotation_BN4})
        return refined


class EllipsoidHead(GaussianHead):
    """Head `qgs/gaussian_head` with rotations and scales relative to the anchor's ellipsoid.

    A Gaussian is rotated by the head's rotation, then by the anchor's. The head's scale along an
    axis of the Gaussian is multiplied by the ellipsoid's radius in the direction of this axis. This
    radius is 1 / |u / r|, with u the unit vector of the axis in the anchor's frame, and r the three
    radii.
    """

    name = "gaussian_head"

    class Config(GaussianHead.Config, RadiusOptions):
        """Options of `qgs/gaussian_head`, but with `scale_cap` in radii of the anchor."""

    config: Config

    @classmethod
    def fields_read(cls, config: Config) -> Fields:
        return shape_fields(config)

    def forward(self, state: QueryState) -> GaussianAttributes:
        """Return attributes of (B, N, K) Gaussians from features (B, N, D) and ellipsoids."""
        local = super().forward(state)
        quats = unit(local.quats)
        # The anchor's rotation comes after the Gaussian's own.
        turn = unit(state[ROTATION])[:, :, None].expand_as(quats)
        scales = local.scales * radii_along(support_radius(state[RAW_RADII], self.config), quats)
        return local.replace(quats=quat_product(turn, quats), scales=scales)


@full_precision
def radii_along(radii_BN3: Tensor, quats_BNK4: Tensor) -> Tensor:
    """Return the radii (B, N, K, 3) of ellipsoids in the directions of their Gaussians' axes.

    radii: radii along the axes of each ellipsoid. quats: rotations from Gaussian to anchor. In
    direction u of the anchor's frame an ellipsoid with radii r has the radius 1 / |u / r|.
    """
    return 1 / (quat_to_matrix(quats_BNK4) / radii_BN3[:, :, None, :, None]).norm(dim=-2)


class AxisScaledCenters(RadiusScaledCenters):
    """Gaussian means at mu + R diag(r) posact(offset), for ellipsoidal anchors.

    An anchor has the centre mu, the rotation R and the radii r. `offset` is an output of the head,
    and posact(t) is sign(t) (exp|t| - 1).
    """

    name = "axis_scaled"

    @classmethod
    def fields_read(cls, config: RadiusScaledCenters.Config) -> Fields:
        return {**CENTER_FIELD, **shape_fields(config)}

    @full_precision
    def steps(self, displaced: Tensor, state: QueryState) -> Tensor:
        """Return steps from the centre, for displacements in radii along the ellipsoid's axes."""
        return displaced @ anchor_axes(state, self.config).mT
