"""`ellipsoid/gaussian_head`: Gaussians whose rotations and scales an anchor's frame is base of."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import ClassVar, Literal

import torch.nn.functional as F
from qgs_locus.fields import RadiusOptions, support_radius
from torch import Tensor

from qgs.components import GaussianHead
from qgs.contracts import Fields, Problem, RecipeContext, without_effect
from qgs.geometry.precision import full_precision
from qgs.geometry.rotations import quat_to_matrix
from qgs.types import GaussianAttributes, QueryState
from qgs_ellipsoid.fields import (
    RAW_RADII,
    ROTATION,
    ROTATION_FIELD,
    anchor_rotation,
    shape_fields,
)
from qgs_ellipsoid.rotations import quat_product

Frame = Literal["world", "anchor"]


class EllipsoidHead(GaussianHead):
    """`qgs/gaussian_head`, whose rotations and scales may be those of the anchor's frame."""

    name: ClassVar[str] = "gaussian_head"

    class Config(GaussianHead.Config, RadiusOptions):
        """As `qgs/gaussian_head`, and the frames of what it decodes.

        rotations: "anchor" turns Gaussians with their anchor. scales: "anchor" measures a Gaussian
        along each of its axes by the radius that the ellipsoid has in that direction, so that
        `scale_cap` is a multiple of that radius.
        """

        rotations: Frame = "anchor"
        scales: Frame = "anchor"

    config: Config

    @classmethod
    def requires(cls, config: Config) -> Fields:
        """The rotation or the whole shape, as the frames need."""
        if config.scales == "anchor":
            return shape_fields(config)
        return ROTATION_FIELD if config.rotations == "anchor" else {}

    @classmethod
    def problems(cls, config: Config, context: RecipeContext) -> Iterable[Problem]:
        """Readings of a radius need scales that follow it, and something must follow the anchor."""
        yield from super().problems(config, context)
        if config.rotations == config.scales == "world":
            reason = "`rotations` and `scales` are of the world: nothing follows the anchor"
            yield Problem("", reason, "use `qgs/gaussian_head`, or set one of them to anchor")
        if config.scales == "world":
            idle = ("radius_bound", "radius_min")
            yield from without_effect(config, idle, "`scales` are of the world")

    def forward(self, state: QueryState) -> GaussianAttributes:
        """(B, N, D) and the anchors' shapes -> attributes of (B, N, K) Gaussians."""
        decoded = super().forward(state)
        if self.config.rotations == "anchor":
            rotation = F.normalize(state[ROTATION], dim=-1)[:, :, None]
            turned = quat_product(rotation.expand_as(decoded.quats), decoded.quats)
            decoded = replace(decoded, quats=turned)
        if self.config.scales == "anchor":
            radii = support_radius(state[RAW_RADII], self.config)
            along = radii_along(anchor_rotation(state[ROTATION]), radii, decoded.quats)
            decoded = replace(decoded, scales=decoded.scales * along)
        return decoded


@full_precision
def radii_along(rotation: Tensor, radii: Tensor, quats: Tensor) -> Tensor:
    """Radii (B, N, K, 3) of ellipsoids in the directions of the axes of their Gaussians.

    rotation (B, N, 3, 3), anchor to world; radii (B, N, 3); quats (B, N, K, 4), Gaussian to world.
    A unit vector u of the anchor's frame leaves the ellipsoid at 1 / |u / r|.
    """
    axes = rotation.mT[:, :, None] @ quat_to_matrix(quats)
    return 1 / (axes / radii[:, :, None, :, None]).norm(dim=-2)
