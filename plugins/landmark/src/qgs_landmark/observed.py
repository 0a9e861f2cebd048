"""`landmark/observed`: queries whose anchors start on rays of the photos, at a predicted depth."""

import math
from collections.abc import Iterable

import torch
from pydantic import Field, ValidationInfo, field_validator
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
from qgs.geometry.constants import constant
from qgs.geometry.precision import at_least_float32, full_precision
from qgs.types import ImageMemory, QueryState, SpatialSupport, Views
from qgs_landmark.fields import COLORS, FRAME, FRAME_FIELD, color_field
from qgs_landmark.places import (
    cells,
    colors_at,
    footprint,
    patch_centres,
    rays_at,
    sampled,
    spread,
)
from qgs_landmark.sweep import mismatch

SHARPNESS = 300.0
"""1 / t at first: a difference of .01 in RGB makes a depth e times less likely."""
UNSEEN = 0.2
"""Difference in RGB at first that a depth which no other photo sees is taken to have."""
SAMPLES = 4
"""Samples along each side of a window."""


class ObservedQueries(Queries):
    """A query at a place of a photo: the token there, and an anchor on the ray through it.

    The anchor's depth z, along the camera's axis, is near^w far^(1 - w), with w the sigmoid of an
    MLP of the token. With a sweep w is the mean of D values from 0 to 1, with weights softmax(
    MLP(token) - c / t): c is how much the photo differs from the others where it shows that depth.
    The radius is `radius` sides of the anchor's footprint at its depth: the part of the photo that
    is its share of all photos, a square, or a tile with the side of a square of its area.
    """

    name = "observed"
    reads = memory_fields("features", "grid")

    class Config(RadiusOptions):
        count: int | None = Field(default=256, ge=1)
        """N, the number of queries, spread evenly over all input photos, whatever their number and
        size: in tiles where they can be, in rows otherwise (`places.footprint`); null for
        `per_token` at the centre of each token's patch."""
        parts: int = Field(default=1, ge=1)
        """S, parts of its footprint whose tokens and depths make a query of `count`."""
        per_token: int = Field(default=1, ge=1)
        """Queries of each token where `count` is null; each has a learned vector of its own."""
        near: float = Field(default=0.2, gt=0)
        """Least depth, world units."""
        far: float = Field(default=3.0, gt=0, validate_default=True)
        """Largest depth, world units."""
        sweep: int | None = Field(default=None, ge=2)
        """D, the depths at which photos are compared; null for a depth by the token alone."""
        window: float = Field(default=1.5, gt=0)
        """Side of the squares that are compared, in sides of the footprint."""
        radius: float = Field(default=1.0, gt=0)
        """Radius that an anchor starts with, in sides of its footprint at its depth."""
        std: float = Field(default=0.3, ge=0)
        """Standard deviation that the learned vectors start from, which are added to tokens."""
        cells: int | None = Field(default=None, ge=1)
        """K, parts of its footprint whose colours a query knows, for the Gaussians of
        `landmark/colored`; null where nothing reads them."""

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
        self.depth_mlp = Mlp(dims.width, dims.width, config.sweep or 1)
        nn.init.zeros_(self.depth_mlp.fc2.weight)
        nn.init.zeros_(self.depth_mlp.fc2.bias)
        if config.sweep is not None:
            self.sharpness = nn.Parameter(torch.tensor(math.log(SHARPNESS)))
            self.unseen = nn.Parameter(torch.tensor(UNSEEN))
            self.match_proj = nn.Linear(config.sweep, dims.width)
        if config.parts > 1:
            self.part_proj = nn.Linear((config.parts - 1) * dims.width, dims.width, bias=False)

    @classmethod
    def fields_written(cls, config: Config) -> Fields:
        """Centre, raw radius, the axes of the photo, and colours."""
        colors = color_field(config.cells) if config.cells else {}
        return {**CENTER_FIELD, **radius_field(config), **FRAME_FIELD, **colors}

    @classmethod
    def problems(cls, config: Config, context: RecipeContext) -> Iterable[Problem]:
        """`per_token` where points are chosen without regard to tokens, `parts` where by them."""
        if config.count is None:
            yield from without_effect(config, ("parts",), "`count` is null")
        else:
            yield from without_effect(config, ("per_token",), "`count` is a number")

    def forward(self, memory: ImageMemory, views: Views) -> QueryState:
        """Features (B, N, D), fields of anchors (B, N, ...), those of footprints with `cells`."""
        assert memory.grid is not None
        (count, rows, columns), device = memory.grid, memory.features.device
        each, scenes = self.config.per_token, len(memory.features)
        if self.config.count is None:
            place_BN2 = patch_centres(rows, columns, device).repeat(count, 1)
            place_BN2 = place_BN2.repeat_interleave(each, 0).expand(scenes, -1, -1)
            view_N = torch.arange(count, device=device).repeat_interleave(rows * columns * each)
            x_BND = (memory.features[:, :, None] + self.slots).flatten(1, 2)
            x_BND, nearness_BN1 = self._seen(x_BND, views, view_N, place_BN2)
        else:
            view_N, place_N2 = spread(self.config.count, count, views.cameras.size, device)
            place_BN2 = place_N2.expand(scenes, -1, -1)
            view_X, place_BX2 = self._divided(self.config.parts, views, view_N, place_BN2)
            x_BXD = sampled(memory.features, memory.grid, view_X, place_BX2) + self.slots
            x_BND, nearness_BN1 = self._joined(*self._seen(x_BXD, views, view_X, place_BX2))
        return QueryState(x_BND, self._fields(nearness_BN1, views, view_N, place_BN2))

    def _divided(
        self, count: int, views: Views, view_N: Tensor, place_BN2: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Views (X,) and places (B, X, 2) of the middles of `count` parts of each footprint."""
        (height, width), (wide, high) = views.cameras.size, self._footprint(views, len(view_N))
        share_2 = constant([wide / width, high / height], place_BN2)
        step_K2 = share_2 * cells(count, place_BN2, high / wide)
        place_BX2 = (place_BN2[:, :, None] + step_K2).flatten(1, 2)
        return view_N.repeat_interleave(count), place_BX2

    def _seen(
        self, x_BND: Tensor, views: Views, view_N: Tensor, place_BN2: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Features, with what a sweep shows in them, and how near places are (B, N, 1): w."""
        if self.config.sweep is None:
            return x_BND, at_least_float32(self.depth_mlp(x_BND)).sigmoid()
        match_BND = self._match(views, view_N, place_BN2)
        x_BND = x_BND + self.match_proj(match_BND.softmax(-1))
        share_BND = (at_least_float32(self.depth_mlp(x_BND)) + match_BND).softmax(-1)
        # Not as a matrix product, which autocast makes in half precision.
        nearness_D = _nearness(self.config.sweep, x_BND.device)
        return x_BND, (share_BND * nearness_D).sum(-1, keepdim=True)

    def _joined(self, x_BXD: Tensor, nearness_BX1: Tensor) -> tuple[Tensor, Tensor]:
        """Features and nearness of queries, from those of their parts."""
        x_BNSD, nearness_BNS1 = (
            x.unflatten(1, (-1, self.config.parts)) for x in (x_BXD, nearness_BX1)
        )
        mean_BND = x_BNSD.mean(2)
        if self.config.parts > 1:
            apart_BNSD = x_BNSD[:, :, 1:] - mean_BND[:, :, None]  # the first is minus the others
            mean_BND = mean_BND + self.part_proj(apart_BNSD.flatten(2))
        return mean_BND, nearness_BNS1.mean(2)

    def _match(self, views: Views, view_N: Tensor, place_BN2: Tensor) -> Tensor:
        """Logits (B, N, D) of depths, by how well photos agree there."""
        assert self.config.sweep is not None
        depth_D = self._depth(_nearness(self.config.sweep, place_BN2.device))
        side = self.config.window * _side(views, len(view_N))
        error_BND, seen_BND = mismatch(views, view_N, place_BN2, depth_D, side, SAMPLES)
        return -self.sharpness.exp() * torch.where(seen_BND, error_BND, self.unseen)

    def _depth(self, nearness: Tensor) -> Tensor:
        """World units."""
        return self.config.far * (self.config.near / self.config.far) ** nearness

    def _footprint(self, views: Views, count: int) -> tuple[float, float]:
        """Width and height in pixels of what each of `count` queries stands for."""
        if self.config.count is None:
            return _side(views, count), _side(views, count)
        return footprint(count, views.cameras.shape[1], views.cameras.size)

    @full_precision
    def _fields(
        self, nearness_BN1: Tensor, views: Views, view_N: Tensor, place_BN2: Tensor
    ) -> dict[str, Tensor]:
        config, cameras, z_BN1 = self.config, views.cameras, self._depth(nearness_BN1)
        origin_BN3, direction_BN3 = rays_at(cameras, view_N, place_BN2)
        wide, high = self._footprint(views, len(view_N))
        side = math.sqrt(wide * high)
        focal_BN1 = cameras.intrinsics[:, view_N, :2].mean(-1, keepdim=True)
        radii_BN1 = config.radius * side * z_BN1 / focal_BN1
        axes_31 = constant([wide / side, high / side, 1.0], z_BN1)[:, None]
        anchors = {
            CENTER: origin_BN3 + z_BN1 * direction_BN3,
            RAW_RADIUS: raw_radii(radii_BN1, config),
            FRAME: cameras.c2w[:, view_N, :3, :3].mT * axes_31,
        }
        if config.cells is None:
            return anchors
        view_X, place_BX2 = self._divided(config.cells, views, view_N, place_BN2)
        colors = colors_at(views.images, side / math.sqrt(config.cells), view_X, place_BX2)
        return anchors | {COLORS: colors.unflatten(1, (-1, config.cells))}

    def support(self, state: QueryState) -> SpatialSupport:
        """Balls of the support radius."""
        return ball_support(state[CENTER], support_radius(state[RAW_RADIUS], self.config))


def _side(views: Views, count: int) -> float:
    """Side in pixels of squares of which `count` have the area of all photos."""
    return math.sqrt(views.cameras.shape[1] * math.prod(views.cameras.size) / count)


def _nearness(count: int, device: torch.device) -> Tensor:
    """From 0, which is `far`, to 1, which is `near`: (count,)."""
    return torch.linspace(0, 1, count, device=device)
