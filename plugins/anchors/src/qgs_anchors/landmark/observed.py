"""`landmark/observed`: queries with anchors that start on rays of photos, at a predicted depth."""

import math
from collections.abc import Iterable

import torch
import torch.nn.functional as F
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt
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

from qgs.contracts import (
    Fields,
    ModelDims,
    Problem,
    Queries,
    RecipeContext,
    memory_fields,
    without_effect,
)
from qgs.contracts.settings import Far
from qgs.geometry.constants import constant
from qgs.precision import at_least_float32, full_precision
from qgs.tokengs import Mlp
from qgs.types import ImageMemory, QueryState, SpatialSupport, Views
from qgs_anchors.landmark.fields import (
    COLORS,
    FOOTPRINT,
    FOOTPRINT_FIELD,
    FRAME,
    FRAME_FIELD,
    color_field,
)
from qgs_anchors.landmark.places import (
    aspect_of,
    cells,
    colors_at,
    patches,
    rays_at,
    rows_in_square,
    rows_in_tile,
    sampled,
    side_of,
    spread,
)
from qgs_anchors.landmark.sweep import mismatch

SHARPNESS = 300.0
"""Initial factor by which a sweep multiplies colour differences to get logits.

If a depth's difference grows by 1/300 (RGB in [0, 1]), the depth's weight is divided by e."""
UNSEEN = 0.2
"""Initial value of the learned colour difference for depths that no other photo sees."""
SAMPLES = 4
"""Number of samples along each side of the square in which photos are compared."""


class ObservedQueries(Queries):
    """Queries made from points of photos; each anchor starts on the ray through its point.

    The initial features of a query are computed from the image token at its point. The depth of
    the anchor along the camera's axis is z = near^w far^(1 - w), with w the sigmoid of
    an MLP of the token. With a sweep over D depths, w is the mean of D values from 0 to 1 with
    weights softmax(MLP(token) - c / t). The cost c of a depth is the difference in colour between
    this photo and the other photos at that depth; t is learned.

    A query's footprint is the part of its photo that it represents, a tile or a square. The side of
    a footprint is the square root of its area. The initial radius of the anchor is `radius` times
    this side, projected to the anchor's depth.

    A query may sample S tokens at points of its footprint. Its features start as the mean of the
    tokens, plus a learned matrix times S - 1 differences: each token except the first, minus the
    mean. The w of the query is the mean over its S tokens.
    """

    name = "observed"
    reads = memory_fields("features", "grid")

    class Config(RadiusOptions):
        count: PositiveInt | None = 256
        """N, the number of queries, spread evenly over the input photos. The footprint of
        a query is the part of a photo that the query represents. If photos divide into N equal
        tiles with nearly square cells, each footprint is a tile; otherwise it is a square around
        the query's point. Null puts `per_token` queries at the centre of each token's patch."""
        least: PositiveInt | None = None
        """Smallest number of queries in a training step. Each step takes a random number from
        `least` to `count`, with an even distribution of its logarithm. Then all footprints are
        squares, and a trained model may have any number between. Null always takes `count`."""
        tokens: PositiveInt = 1
        """S, the number of points in the footprint of a query at which the query samples tokens
        and depths. It has an effect only if `count` is a number."""
        per_token: PositiveInt = 1
        """Number of queries for each token if `count` is null. Each query adds a learned vector of
        its own to the token."""
        near: PositiveFloat = 0.2
        """Least initial depth of an anchor, world units."""
        far: Far = 3.0
        """Largest initial depth of an anchor, world units."""
        sweep: int | None = Field(default=None, ge=2)
        """D, the number of depths at which photos are compared to find the depth of an anchor. Null
        predicts the depth from the token alone."""
        window: PositiveFloat = 1.5
        """Side of the squares of photos that a sweep compares. The unit is sqrt(A / S), with A the
        area of the query's footprint and S the option `tokens`."""
        radius: PositiveFloat = 1.0
        """Initial radius of an anchor. The unit is sqrt(A) z / f, with A the area of the query's
        footprint in pixels, z the anchor's depth and f the focal length in pixels."""
        std: NonNegativeFloat = 0.3
        """Standard deviation of the initial learned vectors, which are added to the tokens."""
        cells: PositiveInt | None = None
        """K, the number of cells into which a footprint is divided. Queries store the mean colour
        of each cell for the head `landmark/colored`. Null stores no colours. The option `count`
        decides the rows: null splits 8 cells into 2, 3 and 3, a number into 2 rows of 4."""

    config: Config

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        # Only these make queries at one place different.
        self.slots = nn.Parameter(torch.randn(config.per_token, dims.width) * config.std)
        self.depth_mlp = Mlp(dims.width, dims.width, config.sweep or 1)
        # With zero logits, every depth starts in the middle, or where the photos agree best.
        for parameter in self.depth_mlp.fc2.parameters():
            nn.init.zeros_(parameter)
        if config.sweep is not None:
            # As a logarithm, so that it stays positive.
            self.sharpness = nn.Parameter(torch.tensor(math.log(SHARPNESS)))
            self.unseen = nn.Parameter(torch.tensor(UNSEEN))
            # The curve of agreement shows how certain a depth is; later layers can use it.
            self.match_proj = nn.Linear(config.sweep, dims.width)
        if config.tokens > 1:
            self.apart_proj = nn.Linear((config.tokens - 1) * dims.width, dims.width, bias=False)

    @classmethod
    def fields_written(cls, config: Config) -> Fields:
        colors = color_field(config.cells) if config.cells else {}
        anchor = {**CENTER_FIELD, **radius_field(config), **FRAME_FIELD}
        return {**anchor, **FOOTPRINT_FIELD, **colors}

    @classmethod
    def problems(cls, config: Config, context: RecipeContext) -> Iterable[Problem]:
        """Report options without effect, and a `least` that is more than `count`."""
        if config.count is None:
            yield from without_effect(config, ("tokens", "least"), "`count` is null")
            return
        yield from without_effect(config, ("per_token",), "`count` is a number")
        if config.least and config.least > config.count:
            reason = f"`least` is {config.least}, more than `count`, which is {config.count}"
            yield Problem("least", reason, f"write at most {config.count}, or raise `count`")

    @property
    def trained_counts(self) -> tuple[int, int] | None:
        config = self.config
        return (config.least, config.count) if config.least and config.count else None

    def forward(self, memory: ImageMemory, views: Views) -> QueryState:
        """Return initial queries: features (B, N, D), and the fields in `fields_written`."""
        assert memory.grid is not None
        config = self.config
        device = memory.features.device
        size = views.cameras.size
        if config.count is None:
            view_N, place_N2, share_2 = patches(memory.grid, config.per_token, size, device)
            # Each query is at its token: nothing has to be interpolated.
            x_BND = (memory.features[:, :, None] + self.slots).flatten(1, 2)
            x_BND, nearness_BN1 = self._swept(x_BND, views, view_N, place_N2)
        else:
            photos = memory.grid[0]
            # Few random numbers fill photos with tiles, but training and evaluation must agree.
            aspect = math.inf if config.least else aspect_of(config.cells or 1)
            count = self._drawn(config.count)
            view_N, place_N2, share_2 = spread(count, photos, size, aspect, device)
            # Several tokens of a tile start one query, so that it knows more than the centre.
            middle_S2 = cells(config.tokens, rows_in_tile(config.tokens), place_N2)
            place_X2 = (place_N2[:, None] + share_2 * middle_S2).flatten(0, 1)
            view_X = view_N.repeat_interleave(config.tokens)
            x_BXD = sampled(memory.features, memory.grid, view_X, place_X2) + self.slots
            x_BND, nearness_BN1 = self._joined(*self._swept(x_BXD, views, view_X, place_X2))
        return QueryState(x_BND, self._fields(nearness_BN1, views, view_N, place_N2, share_2))

    def _drawn(self, count: int) -> int:
        """Return the number of queries for one pass. It is random in training with `least`."""
        if not self.training or self.config.least is None:
            return count
        share = torch.rand(()).item()
        return round(self.config.least ** (1 - share) * count**share)

    def _swept(
        self, x_BND: Tensor, views: Views, view_N: Tensor, place_N2: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return features (B, N, D) and nearness (B, N, 1) of N points of photos.

        Nearness is log depth, scaled to 0 at depth `far` and 1 at `near`. With the option `sweep`,
        features and nearness depend on how well the photos agree at each depth.
        """
        if self.config.sweep is None:
            return x_BND, at_least_float32(self.depth_mlp(x_BND)).sigmoid()
        nearness_D = torch.linspace(0, 1, self.config.sweep, device=x_BND.device)
        side = self.config.window * side_of(len(view_N), views.cameras.shape[1], views.cameras.size)
        error_BND, seen_BND = mismatch(
            views, view_N, place_N2, self._depth(nearness_D), side, SAMPLES
        )
        # These logits of depths are high where the photos agree.
        match_BND = -self.sharpness.exp() * torch.where(seen_BND, error_BND, self.unseen)
        x_BND = x_BND + self.match_proj(match_BND.softmax(-1))
        # Logits add up: the network only has to correct the result of the comparison.
        share_BND = (at_least_float32(self.depth_mlp(x_BND)) + match_BND).softmax(-1)
        # Not a matrix product, which autocast would compute in half precision.
        return x_BND, (share_BND * nearness_D).sum(-1, keepdim=True)

    def _joined(self, x_BXD: Tensor, nearness_BX1: Tensor) -> tuple[Tensor, Tensor]:
        """Merge the S features of each query into one, and its S values of nearness into one."""
        tokens = self.config.tokens
        if tokens == 1:
            return x_BXD, nearness_BX1
        x_BNSD, nearness_BNS1 = (x.unflatten(1, (-1, tokens)) for x in (x_BXD, nearness_BX1))
        mean_BND = x_BNSD.mean(2)
        # The first difference is minus the sum of the others.
        apart_BNSD = x_BNSD[:, :, 1:] - mean_BND[:, :, None]
        return mean_BND + self.apart_proj(apart_BNSD.flatten(2)), nearness_BNS1.mean(2)

    def _depth(self, nearness: Tensor) -> Tensor:
        """Return depths, world units, for a nearness from 0 (`far`) to 1 (`near`)."""
        # Even steps of w are even steps of log depth.
        return self.config.far * (self.config.near / self.config.far) ** nearness

    @full_precision
    def _fields(
        self,
        nearness_BN1: Tensor,
        views: Views,
        view_N: Tensor,
        place_N2: Tensor,
        share_2: Tensor,
    ) -> dict[str, Tensor]:
        """Return the fields of queries at points `place_N2` of the photos `view_N`.

        nearness: log depth, scaled to 0 at depth `far` and 1 at `near`. share_2: width and height
        of footprints, divided by the photo's width and height.
        """
        config = self.config
        cameras = views.cameras
        z_BN1 = self._depth(nearness_BN1)
        origin_BN3, direction_BN13 = rays_at(cameras, view_N, place_N2[:, None])
        side = side_of(len(view_N), cameras.shape[1], cameras.size)
        # A footprint of s pixels is s z / f wide at depth z.
        focal_BN1 = cameras.intrinsics[:, view_N, :2].mean(-1, keepdim=True)
        radii_BN1 = config.radius * side * z_BN1 / focal_BN1
        rows = 0
        if config.cells is not None:
            fill = rows_in_square if config.count is None or config.least else rows_in_tile
            rows = fill(config.cells)
        shape_3 = F.pad(
            share_2.to(z_BN1) * constant(cameras.size[::-1], z_BN1) / side, (0, 1), value=rows
        )
        anchors = {
            # The direction has z = 1 in the camera, so z is a depth, not a distance.
            CENTER: origin_BN3 + z_BN1 * direction_BN13[:, :, 0],
            RAW_RADIUS: raw_radii(radii_BN1, config),
            FRAME: cameras.c2w[:, view_N, :3, :3].mT,
            FOOTPRINT: shape_3.expand(*z_BN1.shape[:2], -1),
        }
        if config.cells is None:
            return anchors
        place_NK2 = place_N2[:, None] + share_2 * cells(config.cells, rows, share_2)
        # The colour of a cell is the mean over its area, which its Gaussian covers.
        colors = colors_at(views.images, side / math.sqrt(config.cells), view_N, place_NK2)
        return anchors | {COLORS: colors}

    def support(self, state: QueryState) -> SpatialSupport:
        """Return each anchor as a ball of its support radius."""
        return ball_support(state[CENTER], support_radius(state[RAW_RADIUS], self.config))
