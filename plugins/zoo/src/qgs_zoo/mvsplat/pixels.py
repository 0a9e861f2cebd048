"""`mvsplat/pixels`, `mvsplat/on_rays`, heads: a query for each pixel, and a Gaussian on its ray.

Each pixel has raw numbers, which a head turns into the attributes of one Gaussian.
"""

from abc import abstractmethod
from collections.abc import Iterable
from typing import ClassVar, Literal

import torch
import torch.nn.functional as F
from einops import rearrange
from pydantic import Field, PositiveFloat
from torch import Tensor

from qgs.contracts import (
    GAUSSIAN_FIELDS,
    Centers,
    ComponentConfig,
    Fields,
    FieldSpec,
    Head,
    Problem,
    Queries,
    RecipeContext,
    memory_fields,
)
from qgs.geometry.harmonics import SH_C0
from qgs.geometry.transforms import quat_product, unit
from qgs.precision import full_precision
from qgs.types import GaussianAttributes, ImageMemory, QueryState, Views
from qgs_zoo.mvsplat.adapter import (
    SH_DEGREE,
    camera_quaternions,
    coefficients,
    world_harmonics,
)
from qgs_zoo.parts import PIXEL_RAYS, pixel_rays, quaternions

PIXEL = "mvsplat.pixel"
TURN = "mvsplat.turn"
PIXEL_FIELDS: Fields = {
    PIXEL: PIXEL_RAYS,
    TURN: FieldSpec((4,), frame="world", encoding="unit quaternion w x y z, camera to world"),
}
"""Query fields: the rays through the pixel of a query, and the rotation of the pixel's camera."""

CHANNELS = (1, 1, 2, 3, 4)
"""Numbers per pixel: log of the depth in world units, opacity logit, raw position in the pixel, raw
scales, raw quaternion x y z w in the camera's frame. Coefficients of harmonics come after them, all
of red, then green, then blue."""
LOG_DEPTH = 20.0
"""Largest |logarithm of a depth|: larger ones are clamped, so that positions are finite."""


WIDTHS = {sum(CHANNELS) + 3 * coefficients(degree): degree for degree in (1, 2, 3, 4)}
"""Degrees of harmonics, by the model width that CHANNELS and all coefficients fill exactly."""


def degree_of(width: int) -> int:
    """Return the largest degree of harmonics that fits into the `width` features of a pixel.

    Features after those of this degree are not read.
    """
    return max([1, *(degree for least, degree in WIDTHS.items() if least <= width)])


def parts_of(features_BND: Tensor) -> tuple[Tensor, ...]:
    """Split the features of pixels in CHANNELS, coefficients of harmonics, and unread features."""
    first = sum(CHANNELS)
    last = first + 3 * coefficients(degree_of(features_BND.shape[-1]))
    return features_BND.tensor_split([first, last], -1)


class OfPixels:
    """Part of components whose features hold the numbers of a pixel."""

    @classmethod
    def problems(cls, config: ComponentConfig, context: RecipeContext) -> Iterable[Problem]:
        """Report a model whose width is less than the number of channels that a pixel needs."""
        width = context.dims.width
        least = min(WIDTHS)
        if width < least:
            reason = f"the model is {width} wide, but a pixel has at least {least} numbers"
            fix = f"set model.width to one of {[*WIDTHS]}, for harmonics of degree 1, 2, 3, 4"
            yield Problem("", reason, fix)


class PixelQueries(OfPixels, Queries):
    """One query for each pixel, with the rays through the pixel and the rotation of its camera.

    The features of a query are the encoder's features of the pixel. Their spherical harmonics are
    rotated from the camera's frame to the world's.
    """

    name = "pixels"
    reads = memory_fields("features", "grid")
    writes = PIXEL_FIELDS

    def forward(self, memory: ImageMemory, views: Views) -> QueryState:
        assert memory.grid is not None
        rotation_BV33 = views.cameras.c2w[..., :3, :3]
        _, rows, columns = memory.grid
        turn = quaternions(rotation_BV33).repeat_interleave(rows * columns, 1)
        fields = {PIXEL: pixel_rays(views.cameras, rows, columns), TURN: turn}
        # Harmonics are predicted in the camera's axes and rendered in the world's.
        return QueryState(in_world(memory.features, rotation_BV33), fields)


@full_precision
def in_world(features_BMD: Tensor, rotation_BV33: Tensor) -> Tensor:
    """Rotate the harmonics in the features of pixels from the cameras' frames to the world frame.

    features: features of the pixels, view by view. rotation: camera to world.
    """
    degree = degree_of(features_BMD.shape[-1])
    views = rotation_BV33.shape[1]
    before, sh_BMC, behind = parts_of(features_BMD)
    sh_BVPXK = sh_BMC.unflatten(1, (views, -1)).unflatten(-1, (3, -1))
    world = torch.einsum("bvkl,bvpxl->bvpxk", world_harmonics(rotation_BV33, degree), sh_BVPXK)
    return torch.cat([before, world.flatten(1, 2).flatten(2), behind], -1)


class OnRays(Centers):
    """Gaussian means at o + t d on rays through pixels, with o the camera's centre.

    A Gaussian's three offsets are two raw numbers and the logarithm of t in world units. The ray
    with direction d goes through a position in the pixel. The sigmoids of the raw numbers are this
    position, from the pixel's upper left corner, in pixels.
    """

    name = "on_rays"
    reads: ClassVar[Fields] = {PIXEL: PIXEL_RAYS}

    class Config(ComponentConfig):
        measure: Literal["distance", "depth"] = "distance"
        """Direction in which t is measured. `distance`: along the ray (MVSplat). `depth`: along the
        camera's axis (DepthSplat). MVSplat's sweep finds depths, but its head uses them as
        distances, which its published weights expect."""

    config: Config

    @full_precision
    def forward(self, offsets: Tensor, state: QueryState) -> Tensor:
        unit = self.config.measure == "distance"
        directions = ray_directions(offsets[..., :2], state[PIXEL], unit)
        return state[PIXEL][:, :, None, 0] + depths(offsets[..., 2:]) * directions


def ray_directions(place_BNK2: Tensor, pixel_BN43: Tensor, unit: bool) -> Tensor:
    """Return directions (B, N, K, 3) of rays through K points inside each of N pixels.

    place: logits of the points' positions. pixel: encoded as PIXEL_RAYS. unit: True gives
    directions of length 1, False directions with z = 1 in the camera's frame.
    """
    _, corner, across, down = pixel_BN43[:, :, None].unbind(-2)
    # The sigmoid keeps places inside their pixel.
    u, v = place_BNK2.sigmoid()[..., None].unbind(-2)
    directions = corner + u * across + v * down
    return F.normalize(directions, dim=-1) if unit else directions


def depths(log_depth: Tensor) -> Tensor:
    """Return depths from their logarithms, which are clamped so that depths are finite."""
    return log_depth.clamp(-LOG_DEPTH, LOG_DEPTH).exp()


SCALE_FACTOR = 0.1
SCALE_SHIFT = 4.0
"""Number subtracted from DepthSplat's raw scales, which then start at softplus(-4) = 0.018."""


class PixelHead(OfPixels, Head):
    """Base of heads without parameters that turn each query of `mvsplat/pixels` into a Gaussian."""

    writes: ClassVar[Fields] = {"gaussians.sh": GAUSSIAN_FIELDS["gaussians.sh"]}

    @abstractmethod
    def scales(self, raw: Tensor, log_depth: Tensor, state: QueryState) -> Tensor:
        """Return scales (B, N, 1, 3) in world units, from raw scales and logarithms of depths."""

    def opacities(self, p: Tensor) -> Tensor:
        """Return the opacities of Gaussians. p: sigmoids of raw opacities."""
        return p

    @property
    def gaussians_per_query(self) -> int:
        return 1

    @full_precision
    def forward(self, state: QueryState) -> GaussianAttributes:
        raw_BNC, sh_BNC, _ = parts_of(state.features)
        log_depth, logit, place, scale, rotation = raw_BNC[:, :, None].split(CHANNELS, -1)
        # Harmonics of degrees above 3 are left out, because they are not rendered.
        sh = rearrange(sh_BNC, "b n (x k) -> b n 1 k x", x=3)[..., : coefficients(SH_DEGREE), :]
        # Zeros mean no rotation in the camera's frame.
        in_camera = unit(camera_quaternions(rotation).roll(1, -1))
        return GaussianAttributes(
            offsets=torch.cat([place, log_depth], -1),
            scales=self.scales(scale, log_depth, state),
            quats=F.normalize(quat_product(state[TURN][:, :, None], in_camera), dim=-1),
            opacities=self.opacities(logit[..., 0].sigmoid()),
            # Zeros are grey in MVSplat; DepthSplat has already added the colour of the photo.
            colors=0.5 + SH_C0 * sh[..., 0, :],
            sh=sh[..., 1:, :].clone(),
        )


class RayHead(PixelHead):
    """Head of MVSplat: scales are proportional to the size of a pixel at the Gaussian's depth.

    Scales are (scale_min + (scale_max - scale_min) sigmoid(raw)) * 0.1 t (1 / fx + 1 / fy), with t
    the depth and fx, fy the focal lengths in pixels. Opacities are (1 - (1 - p)^e + p^(1 / e)) / 2,
    with p the sigmoid of the logit and e = 2^opacity_exponent.
    """

    name = "gaussians"
    scheduled = frozenset({"opacity_exponent"})
    reads = PIXEL_FIELDS

    class Config(ComponentConfig):
        scale_min: PositiveFloat = 0.5
        """Least scale of a Gaussian. The unit is 0.1 times the sum of width and height of a pixel
        at the Gaussian's depth."""
        scale_max: PositiveFloat = 15.0
        """Largest scale of a Gaussian. The unit is 0.1 times the sum of width and height of a pixel
        at the Gaussian's depth."""
        opacity_exponent: float = Field(default=0.0, ge=-10, le=10)
        """Base-2 logarithm of e in the opacity (1 - (1 - p)^e + p^(1 / e)) / 2, with p the sigmoid
        of the logit. 0 gives p (published)."""

    config: Config

    def scales(self, raw: Tensor, log_depth: Tensor, state: QueryState) -> Tensor:
        # From scale_min to scale_max, in pixels at the Gaussian's own depth.
        least = self.config.scale_min
        factor = least + (self.config.scale_max - least) * raw.sigmoid()
        # Width plus height of a pixel at depth 1.
        size = SCALE_FACTOR * state[PIXEL][:, :, 2:].norm(dim=-1).sum(-1)[..., None, None]
        return factor * depths(log_depth) * size

    def opacities(self, p: Tensor) -> Tensor:
        return mapped_opacity(p, self.config.opacity_exponent)


class WorldHead(PixelHead):
    """Head of DepthSplat: scales do not depend on the depth and size of a pixel.

    Scales are softplus(raw - 4), bounded by `scale_min` and `scale_max`.
    """

    name = "depthsplat_gaussians"
    reads: ClassVar[Fields] = {TURN: PIXEL_FIELDS[TURN]}

    class Config(ComponentConfig):
        scale_min: PositiveFloat = 1e-10
        """Least scale of a Gaussian, in world units."""
        scale_max: PositiveFloat = 3.0
        """Largest scale of a Gaussian, in world units. DepthSplat's demos at 512 x 960 use 0.1."""

    config: Config

    def scales(self, raw: Tensor, log_depth: Tensor, state: QueryState) -> Tensor:
        return F.softplus(raw - SCALE_SHIFT).clamp(self.config.scale_min, self.config.scale_max)


def mapped_opacity(p: Tensor, exponent: float) -> Tensor:
    """Return opacities (1 - (1 - p)^e + p^(1 / e)) / 2 from sigmoids p, with e = 2^exponent."""
    if exponent == 0:
        return p
    # The mean of two curves, which is p for an exponent of 0 (published weights). The released code
    # took the map from pixelSplat, which uses it to sharpen opacities during training.
    power = 2.0**exponent
    inside = (p > 0) & (p < 1)
    # 0 and 1 stay as they are, because the slope of the map may be infinite there.
    q = torch.where(inside, p, 0.5)
    return torch.where(inside, 0.5 * (1 - (1 - q) ** power + q ** (1 / power)), p)
