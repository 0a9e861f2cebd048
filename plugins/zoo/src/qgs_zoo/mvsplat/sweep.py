"""Plane sweep: correlation of a view's features with those of other views at each depth.

This file also has the base of both encoders: range of depths, image sizes, a token per pixel.
"""

import math
from abc import abstractmethod
from collections.abc import Callable, Iterable, Sequence

import torch
import torch.nn.functional as F
from einops import rearrange
from pydantic import Field, ValidationInfo, field_validator
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from qgs.contracts import (
    ComponentConfig,
    Encoder,
    OptionError,
    Problem,
    RecipeContext,
    memory_fields,
)
from qgs.geometry.constants import constant
from qgs.precision import full_precision
from qgs.types import Cameras, ImageMemory, Views
from qgs_zoo.mvsplat.pixels import width_problems

MIN_DEPTH = 1e-3
"""Least z in another camera, world units: points behind it project far outside its image."""
MAX_SAMPLES = 1 << 24
"""Numbers that are sampled at once (64 MiB in float32)."""
PAIRS = 40
"""Largest number of pixels per candidate for which all pairs of pixels are correlated."""


def cyclic_neighbours(scenes: int, views: int, device: torch.device) -> Tensor:
    """Return the views (B, V, V - 1) after each view, cyclically.

    A single view is its own neighbour.
    """
    view = torch.arange(views, device=device)
    # A single view is compared with itself.
    step = torch.arange(1, max(views, 2), device=device)
    return ((view[:, None] + step) % views).expand(scenes, -1, -1)


@full_precision
def inverse_depth_candidates(near_BV: Tensor, far_BV: Tensor, count: int) -> Tensor:
    """Return inverse depths (B, V, D), linear from 1/far to 1/near, both included."""
    step_D = torch.linspace(0, 1, count, device=near_BV.device).to(near_BV)
    least = 1 / far_BV[..., None]
    return least + step_D * (1 / near_BV[..., None] - least)


@full_precision
def relative_poses(c2w_BV44: Tensor, neighbours_BVJ: Tensor) -> Tensor:
    """Return poses (B, V, J, 4, 4) from the camera of each view to those of its neighbours."""
    scenes = torch.arange(len(c2w_BV44), device=c2w_BV44.device)[:, None, None]
    return c2w_BV44[scenes, neighbours_BVJ].inverse() @ c2w_BV44[:, :, None]


@full_precision
def feature_lenses(cameras: Cameras, size: Sequence[int]) -> Tensor:
    """Return the intrinsics (B, V, 4) of cameras for images resized to `size`, (H, W)."""
    scale = (size[1] / cameras.size[1], size[0] / cameras.size[0])
    return cameras.intrinsics * constant([*scale, *scale], cameras.intrinsics)


@full_precision
def warp_grid(depth_NDhw: Tensor, lens_N4: Tensor, pose_N44: Tensor) -> Tensor:
    """Return positions (N, D, h, w, 2) in another view of pixels at depths, for `grid_sample`.

    depth_NDhw: camera-frame z, world units, with the height and width of the feature map.
    """
    height, width = depth_NDhw.shape[-2:]
    fx, fy, cx, cy = (x[:, None, None] for x in lens_N4.unbind(-1))
    # Pixel centres are whole numbers here, without the half of rays: published weights expect it.
    x_w = torch.arange(width, device=depth_NDhw.device).to(depth_NDhw)
    y_h1 = torch.arange(height, device=depth_NDhw.device).to(depth_NDhw)[:, None]
    ray = ((x_w - cx) / fx).expand(-1, height, -1), ((y_h1 - cy) / fy).expand(-1, -1, width)
    ray_Nhw3 = torch.stack([*ray, torch.ones_like(ray[0])], -1)
    turned_Nhw3 = torch.einsum("nij,nhwj->nhwi", pose_N44[:, :3, :3], ray_Nhw3)
    point = turned_Nhw3[:, None] * depth_NDhw[..., None] + pose_N44[:, None, None, None, :3, 3]
    x, y, depth = point.unbind(-1)
    # Only the divisor is bounded (released code): behind the camera the centre is scaled too.
    z = depth.clamp_min(MIN_DEPTH)
    # The lens of this view is used for the other view too (released code). For views with different
    # lenses this is wrong, but the weights expect it.
    u = (fx[:, None] * x + cx[:, None] * depth) / z
    v = (fy[:, None] * y + cy[:, None] * depth) / z
    return torch.stack([2 * u / (width - 1) - 1, 2 * v / (height - 1) - 1], -1)


def warped(features_NCHW: Tensor, grid_NDhw2: Tensor) -> Tensor:
    """Return features (N, C, D, h, w) of another view at the places of a grid; 0 outside."""
    flat = grid_NDhw2.flatten(1, 2).to(features_NCHW)
    sampled = F.grid_sample(features_NCHW, flat, "bilinear", "zeros", align_corners=True)
    return sampled.unflatten(2, grid_NDhw2.shape[1:3])


def cost_volume(
    features_BVChw: Tensor,
    inverse_depth_BVDhw: Tensor,
    lens_BV4: Tensor,
    poses_BVJ44: Tensor,
    neighbours_BVJ: Tensor,
) -> Tensor:
    """Return the mean correlation <f, f'> / sqrt(C) with the neighbours, (B, V, D, h, w).

    Features outside of a neighbour count as 0. inverse_depth_BVDhw: candidates, 1 / world units; h
    and w may be 1, for the same candidates in all pixels.
    """
    scenes, views, channels, height, width = features_BVChw.shape
    depth_NDhw = (1 / inverse_depth_BVDhw.detach()).flatten(0, 1)
    depth_NDhw = depth_NDhw.expand(-1, -1, height, width)
    own_NChw = features_BVChw.flatten(0, 1)
    lens_N4 = lens_BV4.flatten(0, 1)
    batch = torch.arange(scenes, device=features_BVChw.device)[:, None]
    # Two ways with the same result; the faster one depends on pixels and candidates.
    correlate = _of_all_pairs if height * width <= PAIRS * depth_NDhw.shape[1] else _of_warped
    total_NDhw = depth_NDhw.new_zeros(())
    for index in range(neighbours_BVJ.shape[-1]):
        other_NChw = features_BVChw[batch, neighbours_BVJ[..., index]].flatten(0, 1)
        pose_N44 = poses_BVJ44[:, :, index].flatten(0, 1)
        # Cameras and depths get no gradient: only the features learn from the sweep.
        total_NDhw = total_NDhw + correlate(
            own_NChw, other_NChw, depth_NDhw, lens_N4.detach(), pose_N44.detach()
        )
    mean_NDhw = total_NDhw / (math.sqrt(channels) * neighbours_BVJ.shape[-1])
    return mean_NDhw.unflatten(0, (scenes, views))


def _of_warped(own: Tensor, other: Tensor, depth: Tensor, lens: Tensor, pose: Tensor) -> Tensor:
    """Correlate with warped features, some candidates at a time: (N, D, h, w)."""

    def part(own: Tensor, other: Tensor, depth_Nkhw: Tensor) -> Tensor:
        sampled_NCkhw = warped(other, warp_grid(depth_Nkhw, lens, pose))
        return torch.einsum("nchw,nckhw->nkhw", own, sampled_NCkhw)

    # Parts bound the memory of sampled features.
    parts = depth.split(max(1, MAX_SAMPLES // own.numel()), 1)
    return torch.cat(_each(part, [(own, other, depth_Nkhw) for depth_Nkhw in parts]), 1)


def _of_all_pairs(own: Tensor, other: Tensor, depth: Tensor, lens: Tensor, pose: Tensor) -> Tensor:
    """Compute the same as `_of_warped`: correlate all pairs of pixels, then sample the maps.

    Warping is linear in the features, so it can follow the product. A map has one channel, and all
    maps are one matrix product. This is faster if there are few pixels per candidate.
    """
    count, _, height, width = own.shape
    grid_NPD2 = warp_grid(depth, lens, pose).permute(0, 2, 3, 1, 4).flatten(1, 2)
    own_NPC = own.flatten(2).mT
    other_NCQ = other.flatten(2)

    def part(own_NpC: Tensor, other_NCQ: Tensor, grid_NpD2: Tensor) -> Tensor:
        maps_X1hw = (own_NpC @ other_NCQ).reshape(-1, 1, height, width)
        found = warped(maps_X1hw, grid_NpD2.flatten(0, 1)[:, None, None])
        return found.view(count, -1, depth.shape[1])

    chunk = max(1, MAX_SAMPLES // (count * height * width))
    pairs = zip(own_NPC.split(chunk, 1), grid_NPD2.split(chunk, 1), strict=True)
    parts = _each(part, [(own_NpC, other_NCQ, grid_NpD2) for own_NpC, grid_NpD2 in pairs])
    return torch.cat(parts, 1).mT.unflatten(2, (height, width))


def _each(part: Callable[..., Tensor], given: Sequence[tuple[Tensor, ...]]) -> list[Tensor]:
    """Return `part` of each; to save memory, several are computed again in the backward pass."""
    if len(given) == 1:
        return [part(*given[0])]
    return [
        checkpoint(part, *tensors, use_reentrant=False, preserve_rng_state=False)
        for tensors in given
    ]


class DepthRange(ComponentConfig):
    """Range of depths of a plane sweep."""

    near: float = Field(gt=0)
    """Least depth, world units. Published, for poses as given: 1 for MVSplat, 0.5 for
    DepthSplat."""
    far: float = Field(gt=0)
    """Largest depth, world units. Published: 100, and 200 for DepthSplat on DL3DV."""

    @field_validator("far")
    @classmethod
    def _far_is_beyond_near(cls, far: float, info: ValidationInfo) -> float:
        near = info.data.get("near", 0)
        if far <= near:
            raise OptionError(
                f"far must be beyond near, got near {near:g} and far {far:g}",
                "give the depths at which the scene begins and ends",
            )
        return far


class SweepEncoder(Encoder):
    """Encoder with a token for each pixel, or square of pixels, at depths in a range."""

    # Views are matched in their order. With three or more, the mask of shifted windows depends on
    # the order too (released code).
    ordered_views = True
    writes = memory_fields("features", "grid")
    Config: type[DepthRange]
    config: DepthRange

    @classmethod
    @abstractmethod
    def multiple(cls, config: DepthRange) -> int:
        """Return the number of pixels of which image sides must be multiples.

        Windows and the levels of U-Nets need it.
        """

    @abstractmethod
    def predict(self, views: Views, near_BV: Tensor, far_BV: Tensor) -> Tensor:
        """Return the numbers of every pixel (B, V, C, H, W), for depths from `near` to `far`."""

    @classmethod
    def problems(cls, config: DepthRange, context: RecipeContext) -> Iterable[Problem]:
        yield from width_problems(context)
        size = context.image_size
        multiple = cls.multiple(config)
        if size and any(side % multiple for side in size):
            nearest = [max(round(side / multiple), 1) * multiple for side in size]
            reason = (
                f"images of {size[0]} x {size[1]} (H x W) are not multiples of {multiple} pixels"
            )
            yield Problem("", reason, f"set data.image_size to {nearest}")

    def forward(self, views: Views) -> ImageMemory:
        """Return the memory with one token per pixel.

        Raises ValueError for images that the U-Nets and windows do not divide.
        """
        height, width = views.cameras.size
        multiple = self.multiple(self.config)
        if height % multiple or width % multiple:
            raise ValueError(
                f"images of {height} x {width} (H x W) are not multiples of {multiple} pixels; "
                "resize or crop the views"
            )
        # One range for all views, because data sets do not give one.
        ends = (self.config.near, self.config.far)
        near_BV, far_BV = (views.cameras.c2w.new_full(views.cameras.shape, end) for end in ends)
        numbers_BVCHW = self.predict(views, near_BV, far_BV)
        _, count, _, rows, columns = numbers_BVCHW.shape
        features = rearrange(numbers_BVCHW, "b v c h w -> b (v h w) c")
        return ImageMemory(features, grid=(count, rows, columns))
