"""`mvsplat/pixels`, `mvsplat/on_rays`: a query for each pixel, means on the rays through it."""

from collections.abc import Iterable
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from qgs.contracts import (
    Centers,
    ComponentConfig,
    Fields,
    FieldSpec,
    Problem,
    Queries,
    RecipeContext,
    memory_fields,
)
from qgs.precision import full_precision
from qgs.types import Cameras, ImageMemory, QueryState, Views
from qgs_zoo.mvsplat.adapter import coefficients, world_harmonics
from qgs_zoo.parts import PIXEL_ENCODING, pixel_rays, quaternions

PIXEL = "mvsplat.pixel"
TURN = "mvsplat.turn"
PIXEL_FIELDS: Fields = {
    PIXEL: FieldSpec((4, 3), frame="world", encoding=PIXEL_ENCODING),
    TURN: FieldSpec((4,), frame="world", encoding="unit quaternion w x y z, camera to world"),
}
"""The rays through a pixel, and the rotation of its camera."""
RAY_FIELD: Fields = {PIXEL: PIXEL_FIELDS[PIXEL]}

CHANNELS = (1, 1, 2, 3, 4)
"""Per pixel: logarithm of the depth (world units), opacity logit, raw place in the pixel, raw
scales, raw quaternion x y z w in the camera's frame; behind them harmonics, colour by colour."""
LOG_DEPTH = 20.0
"""Bound of the logarithm of a depth, so that any features give a finite place and a scale."""


WIDTHS = {sum(CHANNELS) + 3 * coefficients(degree): degree for degree in (1, 2, 3, 4)}
"""Widths of a model, and the degree of harmonics that they have room for."""


def degree_of(width: int) -> int:
    """Degree of the harmonics in the numbers of a pixel, D = `width`; those beyond are not read."""
    return max([1, *(degree for least, degree in WIDTHS.items() if least <= width)])


def numbers_of(features_BND: Tensor) -> Tensor:
    """The numbers of pixels: features, with zeros for what a narrow model has no room for."""
    return F.pad(features_BND, (0, max(0, min(WIDTHS) - features_BND.shape[-1])))


def width_problems(context: RecipeContext) -> Iterable[Problem]:
    """A model too narrow for the numbers of a pixel."""
    least = min(WIDTHS)
    if context.dims.width < least:
        reason = f"the model is {context.dims.width} wide, but a pixel has {least} numbers or more"
        fix = f"set model.width to one of {[*WIDTHS]}, for harmonics of degree 1, 2, 3, 4"
        yield Problem("", reason, fix)


class PixelQueries(Queries):
    """A query for each pixel, which knows the rays through its pixel and its camera's rotation.

    Its features are the encoder's numbers, harmonics turned into the world.
    """

    name = "pixels"
    reads = memory_fields("features", "grid")
    writes = PIXEL_FIELDS

    @classmethod
    def problems(cls, config: ComponentConfig, context: RecipeContext) -> Iterable[Problem]:
        return width_problems(context)

    def forward(self, memory: ImageMemory, views: Views) -> QueryState:
        assert memory.grid is not None
        # Harmonics are predicted in the camera's axes and painted in the world's.
        features = in_world(memory.features, views.cameras.c2w[..., :3, :3])
        _, rows, columns = memory.grid
        return QueryState(features, pixel_fields(views.cameras, rows, columns))


@full_precision
def in_world(features_BMD: Tensor, rotation_BV33: Tensor) -> Tensor:
    """Numbers of pixels, ordered by view, with their harmonics turned into the world."""
    numbers_BMC = numbers_of(features_BMD)
    degree = degree_of(features_BMD.shape[-1])
    views = rotation_BV33.shape[1]
    first = sum(CHANNELS)
    last = sum(CHANNELS) + 3 * coefficients(degree)
    sh_BVPXK = numbers_BMC[..., first:last].unflatten(1, (views, -1)).unflatten(-1, (3, -1))
    world = torch.einsum("bvkl,bvpxl->bvpxk", world_harmonics(rotation_BV33, degree), sh_BVPXK)
    world = world.flatten(1, 2).flatten(2)
    changed = torch.cat([numbers_BMC[..., :first], world, numbers_BMC[..., last:]], -1)
    return changed[..., : features_BMD.shape[-1]]


def pixel_fields(cameras: Cameras, rows: int, columns: int) -> dict[str, Tensor]:
    """PIXEL_FIELDS of images (B, V) seen as rows x columns pixels: (B, V*rows*columns, ...)."""
    turn = quaternions(cameras.c2w[..., :3, :3]).repeat_interleave(rows * columns, 1)
    return {PIXEL: pixel_rays(cameras, rows, columns), TURN: turn}


class OnRays(Centers):
    """mean = o + t d; d goes through the place of the Gaussian in its pixel.

    Offsets are two raw numbers, whose sigmoids are that place from the upper left corner, and the
    logarithm of t in world units.
    """

    name = "on_rays"
    reads = RAY_FIELD

    class Config(ComponentConfig):
        measure: Literal["distance", "depth"] = "distance"
        """Whether t counts along the ray (MVSplat), or along the camera's axis (DepthSplat). In
        MVSplat it was found as a depth by the plane sweep; its weights expect the difference."""

    config: Config

    @full_precision
    def forward(self, offsets: Tensor, state: QueryState) -> Tensor:
        unit = self.config.measure == "distance"
        directions = ray_directions(offsets[..., :2], state[PIXEL], unit)
        return state[PIXEL][:, :, None, 0] + depths(offsets[..., 2:]) * directions


def ray_directions(place_BNK2: Tensor, pixel_BN43: Tensor, unit: bool) -> Tensor:
    """Of rays through raw places in pixels (B, N, K, 3): of length 1, or of z = 1."""
    _, corner, across, down = pixel_BN43[:, :, None].unbind(-2)
    # Inside its own pixel, wherever the raw numbers lie.
    u, v = place_BNK2.sigmoid()[..., None].unbind(-2)
    directions = corner + u * across + v * down
    return F.normalize(directions, dim=-1) if unit else directions


def depths(log_depth: Tensor) -> Tensor:
    """Depths, world units, of their logarithms."""
    return log_depth.clamp(-LOG_DEPTH, LOG_DEPTH).exp()
