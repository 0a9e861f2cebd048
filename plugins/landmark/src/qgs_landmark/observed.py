"""`landmark/observed`: queries whose anchors start on rays of the photos, at a predicted depth."""

from collections.abc import Iterable

import torch
import torch.nn.functional as F
from pydantic import Field, ValidationInfo, field_validator
from torch import Tensor, nn

from qgs.components import Mlp
from qgs.contracts import (
    Fields,
    ModelDims,
    OptionError,
    Problem,
    Queries,
    RecipeContext,
    memory_fields,
    without_effect,
)
from qgs.geometry.precision import at_least_float32, full_precision
from qgs.types import Cameras, ImageMemory, QueryState, SpatialSupport, Views
from qgs_locus.fields import (
    CENTER,
    CENTER_FIELD,
    RAW_RADIUS,
    RadiusOptions,
    ball_support,
    radius_field,
    raw_radii,
    support_radius,
)

PLASTIC = 1.32471795724474602596
"""The real root of x^3 = x + 1; its powers step through the unit square most evenly (M. Roberts,
"The Unreasonable Effectiveness of Quasirandom Sequences", 2018: the sequence R2)."""


class ObservedQueries(Queries):
    """A query at a place of a photo: the token there, and an anchor on the ray through it.

    The anchor's depth z, along the camera's axis, is 1 / z = (1 - w) / far + w / near with w the
    sigmoid of an MLP of the token; its radius is `radius` patches of the photo at that depth.
    """

    name = "observed"
    reads = memory_fields("features", "grid")

    class Config(RadiusOptions):
        count: int | None = Field(default=256, ge=1)
        """N, the number of queries, at points spread evenly over all input photos, whatever their
        number and size; null for `per_token` at the centre of each token's patch."""
        per_token: int = Field(default=1, ge=1)
        """Queries of each token where `count` is null; each has a learned vector of its own."""
        near: float = Field(default=0.2, gt=0)
        """Least depth, world units."""
        far: float = Field(default=3.0, gt=0, validate_default=True)
        """Largest depth, world units."""
        radius: float = Field(default=1.0, gt=0)
        """Radius that an anchor starts with, in sides of a patch at its depth."""
        std: float = Field(default=0.3, ge=0)
        """Standard deviation that the learned vectors start from, which are added to tokens."""

        @field_validator("far")
        @classmethod
        def _far_is_behind_near(cls, far: float, info: ValidationInfo) -> float:
            near = info.data.get("near")
            if near is not None and far <= near:
                raise OptionError(
                    f"far must be more than near, {near:g}, got {far:g}",
                    "give the depths at which the scene begins and ends",
                )
            return far

    config: Config

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.slots = nn.Parameter(torch.randn(config.per_token, dims.width) * config.std)
        self.depth_mlp = Mlp(dims.width, dims.width, 1)
        nn.init.zeros_(self.depth_mlp.fc2.weight)  # all anchors start in the middle of parallax
        nn.init.zeros_(self.depth_mlp.fc2.bias)

    @classmethod
    def fields_written(cls, config: Config) -> Fields:
        """Centre and raw radius."""
        return {**CENTER_FIELD, **radius_field(config)}

    @classmethod
    def problems(cls, config: Config, context: RecipeContext) -> Iterable[Problem]:
        """`per_token` where points are chosen without regard to tokens."""
        if config.count is not None:
            yield from without_effect(config, ("per_token",), "`count` is a number")

    def forward(self, memory: ImageMemory, views: Views) -> QueryState:
        """Features (B, N, D), `anchor.center` (B, N, 3) and `anchor.raw_radius` (B, N, 1)."""
        assert memory.grid is not None
        scenes, (count, rows, columns) = len(memory.features), memory.grid
        device = memory.features.device
        if self.config.count is None:
            view_N = torch.arange(count, device=device).repeat_interleave(rows * columns)
            place_BN2 = patch_centres(rows, columns, device).repeat(count, 1).expand(scenes, -1, -1)
            tokens_BND = memory.features
        else:
            each = torch.rand if self.training else torch.zeros
            shift_BV2 = each(scenes, count, 2, device=device)
            view_N, place_BN2 = spread(self.config.count, shift_BV2)
            tokens_BND = tokens_at(memory.features, memory.grid, view_N, place_BN2)
        x_BNPD = tokens_BND[:, :, None] + self.slots
        nearness_BNP = self.depth_mlp(x_BNPD)[..., 0]
        centers, radii = self._anchors(nearness_BNP, views.cameras, memory.grid, view_N, place_BN2)
        fields = {CENTER: centers.flatten(1, 2), RAW_RADIUS: radii.flatten(1, 2)}
        return QueryState(features=x_BNPD.flatten(1, 2), fields=fields)

    @full_precision
    def _anchors(
        self,
        nearness_BNP: Tensor,
        cameras: Cameras,
        grid: tuple[int, int, int],
        view_N: Tensor,
        place_BN2: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Centres (B, N, P, 3) and raw radii (B, N, P, 1)."""
        config, w_BNP = self.config, nearness_BNP.sigmoid()
        z_BNP1 = 1 / ((1 - w_BNP) / config.far + w_BNP / config.near)[..., None]
        origin_BN3, direction_BN3 = rays_at(cameras, view_N, place_BN2)
        centers = origin_BN3[:, :, None] + z_BNP1 * direction_BN3[:, :, None]
        (height, width), (_, rows, columns) = cameras.size, grid
        focal_BN2 = cameras.intrinsics[:, view_N, :2]
        patch_BN1 = focal_BN2.new_tensor([width / columns, height / rows]) / focal_BN2
        patch_BN1 = patch_BN1.mean(-1, keepdim=True)
        return centers, raw_radii(config.radius * patch_BN1[:, :, None] * z_BNP1, config)

    def support(self, state: QueryState) -> SpatialSupport:
        """Balls of the support radius."""
        return ball_support(state[CENTER], support_radius(state[RAW_RADIUS], self.config))


def patch_centres(rows: int, columns: int, device: torch.device) -> Tensor:
    """Places (rows * columns, 2), x and y as shares of a photo's width and height, row by row."""
    y, x = ((torch.arange(n, device=device) + 0.5) / n for n in (rows, columns))
    return torch.cartesian_prod(y, x).flip(-1)


def spread(count: int, shift_BV2: Tensor) -> tuple[Tensor, Tensor]:
    """Views (N,) of N = `count` points, in turn, and their places (B, N, 2) as shares of a photo.

    The points of a view follow the sequence R2, moved by the shift of its scene and view.
    """
    index_N = torch.arange(count, device=shift_BV2.device)
    views = shift_BV2.shape[1]
    view_N, turn_N1 = index_N % views, (index_N // views + 1)[:, None]
    # In float64: the index times a step loses the digits that float32 has after the point.
    step_2 = torch.tensor([1 / PLASTIC, 1 / PLASTIC**2], dtype=torch.float64, device=view_N.device)
    place_BN2 = (0.5 + shift_BV2.double()[:, view_N] + turn_N1 * step_2) % 1
    return view_N, place_BN2.to(shift_BV2)


def tokens_at(
    features_BMD: Tensor, grid: tuple[int, int, int], view_N: Tensor, place_BN2: Tensor
) -> Tensor:
    """Features (B, N, D), bilinear between the centres of patches; beyond them those of the edge.

    place_BN2: x and y as shares of a photo's width and height.
    """
    _, rows, columns = grid
    sizes_2 = place_BN2.new_tensor([columns, rows])
    at_BN2 = (place_BN2 * sizes_2 - 0.5).clamp_min(0).minimum(sizes_2 - 1)
    first_BN2 = at_BN2.floor()
    far_BN2 = at_BN2 - first_BN2
    total_BND = torch.zeros_like(features_BMD[:, :1])
    for x, y in ((0, 0), (1, 0), (0, 1), (1, 1)):
        step_2 = place_BN2.new_tensor([x, y])
        column_BN, row_BN = (first_BN2 + step_2).minimum(sizes_2 - 1).long().unbind(-1)
        index_BN = (view_N * rows + row_BN) * columns + column_BN
        found_BND = features_BMD.take_along_dim(index_BN[..., None], 1)
        share_BN1 = (1 - step_2 + (2 * step_2 - 1) * far_BN2).prod(-1, keepdim=True)
        total_BND = total_BND + share_BN1.to(features_BMD) * found_BND
    return total_BND


def rays_at(cameras: Cameras, view_N: Tensor, place_BN2: Tensor) -> tuple[Tensor, Tensor]:
    """World-frame origins and directions (B, N, 3) through places of photos.

    Directions have length 1 along the axis of their camera.
    """
    height, width = cameras.size
    c2w_BN44, lens_BN4 = cameras.c2w[:, view_N], cameras.intrinsics[:, view_N]
    pixel_BN2 = place_BN2.to(lens_BN4) * lens_BN4.new_tensor([width, height])
    slope_BN2 = (pixel_BN2 - lens_BN4[..., 2:]) / lens_BN4[..., :2]
    local_BN3 = F.pad(slope_BN2, (0, 1), value=1.0)
    return c2w_BN44[..., :3, 3], torch.einsum("bnij,bnj->bni", c2w_BN44[..., :3, :3], local_BN3)
