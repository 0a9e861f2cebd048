"""Plane sweep: correlation of a view's features with the features of other views at each depth.

`SweepEncoder` is the base of the encoders of MVSplat and DepthSplat.
"""

import math
from abc import abstractmethod
from collections.abc import Callable, Iterable
from typing import NamedTuple

import torch
import torch.nn.functional as F
from einops import rearrange
from pydantic import PositiveFloat
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from qgs.contracts import ComponentConfig, Encoder, Problem, RecipeContext, memory_fields
from qgs.contracts.settings import Far
from qgs.geometry.constants import constant
from qgs.geometry.rays import pixel_directions
from qgs.precision import at_least_float32, full_precision
from qgs.types import Cameras, ImageMemory, Views
from qgs_zoo.mvsplat.pixels import OfPixels
from qgs_zoo.parts import feature_lenses

MIN_DEPTH = 1e-3
"""Least z by which a projection divides, world units. Points behind the camera then project far
outside its image."""
MAX_SAMPLES = 1 << 24
"""Largest number of sampled values in memory at once (64 MiB in float32)."""
PAIRS = 40
"""Largest ratio of pixels to depths at which `cost_volume` correlates all pairs of pixels and then
samples the correlations. At higher ratios it samples the features first."""


def cyclic_neighbours(scenes: int, views: int, device: torch.device) -> Tensor:
    """Return the indices (B, V, V - 1) of the views that follow each view in cyclic order.

    The first view follows the last view. A single view is its own neighbour.
    """
    view = torch.arange(views, device=device)
    # A single view is compared with itself.
    step = torch.arange(1, max(views, 2), device=device)
    return ((view[:, None] + step) % views).expand(scenes, -1, -1)


def nearest_neighbours(c2w_BV44: Tensor, count: int) -> Tensor:
    """Return the indices (B, V, J) of the views with which each view is compared.

    With up to three views, these are all other views in ascending order. With more views, they are
    the J = `count` views with the nearest cameras, nearest first.
    """
    scenes, views = c2w_BV44.shape[:2]
    if views <= 3:
        return cyclic_neighbours(scenes, views, c2w_BV44.device).sort().values
    centre_BV3 = at_least_float32(c2w_BV44[..., :3, 3])
    order_BVV = torch.cdist(centre_BV3, centre_BV3).argsort()
    # The first is assumed to be the view itself (released code). If two cameras are at the same
    # place, it may be the other one.
    return order_BVV[..., 1 : count + 1]


def at_neighbours(x: Tensor, neighbours_BVJ: Tensor) -> Tensor:
    """Return the values (B, V, J, ...) of each view's neighbours. x: values (B, V, ...)."""
    scenes = torch.arange(len(x), device=x.device)[:, None, None]
    return x[scenes, neighbours_BVJ]


class Sweep(NamedTuple):
    """Inputs of a plane sweep: cameras, views to compare, and depths.

    cameras: (B, V). neighbours: indices (B, V, J) of the J views with which each view is compared.
    near, far: least and largest depth in world units, (B, V).
    """

    cameras: Cameras
    neighbours: Tensor
    near: Tensor
    far: Tensor


def bounds(sweep: Sweep) -> tuple[Tensor, Tensor]:
    """Return the least and the largest inverse depth of a sweep, two tensors (B V, 1, 1, 1)."""
    # Inverse depth grows towards the camera.
    least, most = (1 / x.flatten()[:, None, None, None] for x in (sweep.far, sweep.near))
    return least, most


@full_precision
def evenly_spaced(low_N1hw: Tensor, high_N1hw: Tensor, count: int) -> Tensor:
    """Return D = `count` inverse depths (N, D, h, w), from `low` to `high` inclusive."""
    part_D11 = torch.linspace(0, 1, count, device=low_N1hw.device).to(low_N1hw)[:, None, None]
    return low_N1hw + part_D11 * (high_N1hw - low_N1hw)


@full_precision
def relative_poses(c2w_BV44: Tensor, neighbours_BVJ: Tensor) -> Tensor:
    """Return poses (B, V, J, 4, 4) from each view's camera to the cameras of its neighbours."""
    return at_neighbours(c2w_BV44, neighbours_BVJ).inverse() @ c2w_BV44[:, :, None]


@full_precision
def warp_grid(depth_NDhw: Tensor, lens_N4: Tensor, pose_N44: Tensor) -> Tensor:
    """Project pixels of N views at D depths into other views: positions (N, D, h, w, 2).

    Positions are in the units of torch's `grid_sample`. depth: camera-frame z of pixels, in world
    units. lens: fx, fy, cx, cy in pixels, used for both cameras. pose: transform from the frame of
    the pixels' camera to the frame of the other camera.
    """
    height, width = depth_NDhw.shape[-2:]
    # Pixel centres are whole numbers here, without the half of rays: published weights expect it.
    half = constant([0, 0, 0.5, 0.5], lens_N4)
    ray_Nhw3 = pixel_directions(lens_N4 + half, (height, width))
    turned_Nhw3 = torch.einsum("nij,nhwj->nhwi", pose_N44[:, :3, :3], ray_Nhw3)
    point = turned_Nhw3[:, None] * depth_NDhw[..., None] + pose_N44[:, None, None, None, :3, 3]
    # The lens of this view is used for the other view too (released code). For views with different
    # lenses this is wrong, but the weights expect it.
    focal, principal = lens_N4[:, None, None, None].split(2, -1)
    xy, depth = point.split((2, 1), -1)
    # Only the divisor is bounded (released code): behind the camera the centre is scaled too.
    pixel = (focal * xy + principal * depth) / depth.clamp_min(MIN_DEPTH)
    return 2 * pixel / constant([width - 1, height - 1], pixel) - 1


def warped(features_NCHW: Tensor, grid_NDhw2: Tensor) -> Tensor:
    """Sample the features of N views at the positions `grid`: (N, C, D, h, w).

    The result is 0 at positions outside of the view's image.
    """
    flat = grid_NDhw2.flatten(1, 2).to(features_NCHW)
    sampled = F.grid_sample(features_NCHW, flat, "bilinear", "zeros", align_corners=True)
    return sampled.unflatten(2, grid_NDhw2.shape[1:3])


def cost_volume(features_BVChw: Tensor, inverse_depth_NDhw: Tensor, sweep: Sweep) -> Tensor:
    """Correlate the features of each pixel with those of neighbour views at D depths.

    Returns the mean over neighbours of <f, f'> / sqrt(C), (B, V, D, h, w). f is the feature of a
    pixel, f' that at its projection into the neighbour view, or 0 outside of that view.
    inverse_depth: the D inverse depths of each pixel, in 1 / world units; h and w of this tensor
    may be 1, which gives all pixels the same depths.
    """
    scenes, views, channels, height, width = features_BVChw.shape
    depth_NDhw = (1 / inverse_depth_NDhw.detach()).expand(-1, -1, height, width)
    own_NChw = features_BVChw.flatten(0, 1)
    neighbours_BVJ = sweep.neighbours
    lens_N4 = feature_lenses(sweep.cameras, (height, width)).flatten(0, 1)
    poses_BVJ44 = relative_poses(sweep.cameras.c2w, neighbours_BVJ)
    # Two ways with the same result; the faster one depends on pixels and candidates.
    correlate = _of_all_pairs if height * width <= PAIRS * depth_NDhw.shape[1] else _of_warped
    total_NDhw = depth_NDhw.new_zeros(())
    for index in range(neighbours_BVJ.shape[-1]):
        neighbour_BV1 = neighbours_BVJ[..., index, None]
        other_NChw = at_neighbours(features_BVChw, neighbour_BV1).flatten(0, 2)
        pose_N44 = poses_BVJ44[:, :, index].flatten(0, 1)
        # Cameras and depths get no gradient: only the features learn from the sweep.
        total_NDhw = total_NDhw + correlate(
            own_NChw, other_NChw, depth_NDhw, lens_N4.detach(), pose_N44.detach()
        )
    mean_NDhw = total_NDhw / (math.sqrt(channels) * neighbours_BVJ.shape[-1])
    return mean_NDhw.unflatten(0, (scenes, views))


def _of_warped(own: Tensor, other: Tensor, depth: Tensor, lens: Tensor, pose: Tensor) -> Tensor:
    """Correlate features of N views with samples of N other views at D depths: (N, D, h, w).

    own, other: features (N, C, h, w). View n of `own` is compared with view n of `other`. depth,
    lens, pose: as in `warp_grid`.
    """

    def part(depth_Nkhw: Tensor) -> Tensor:
        sampled_NCkhw = warped(other, warp_grid(depth_Nkhw, lens, pose))
        return torch.einsum("nchw,nckhw->nkhw", own, sampled_NCkhw)

    # Parts bound the memory of sampled features.
    return _in_parts(part, own.numel(), depth)


def _of_all_pairs(own: Tensor, other: Tensor, depth: Tensor, lens: Tensor, pose: Tensor) -> Tensor:
    """Correlate all pixels of N views with all pixels of other views, then sample: (N, D, h, w).

    The result equals that of `_of_warped` for the same arguments, because sampling is linear in the
    features. All correlations are one matrix product, and sampling them handles one channel instead
    of C. This is faster if there are few pixels per depth.
    """
    count, _, height, width = own.shape
    grid_NPD2 = warp_grid(depth, lens, pose).permute(0, 2, 3, 1, 4).flatten(1, 2)
    other_NCQ = other.flatten(2)

    def part(own_NpC: Tensor, grid_NpD2: Tensor) -> Tensor:
        maps_X1hw = (own_NpC @ other_NCQ).reshape(-1, 1, height, width)
        found = warped(maps_X1hw, grid_NpD2.flatten(0, 1)[:, None, None])
        return found.view(count, -1, depth.shape[1])

    found_NPD = _in_parts(part, count * height * width, own.flatten(2).mT, grid_NPD2)
    return found_NPD.mT.unflatten(2, (height, width))


def _in_parts(part: Callable[..., Tensor], each: int, *whole: Tensor) -> Tensor:
    """Return the result of `part` on the tensors `whole`, computed for parts of their second axis.

    each: number of values that `part` samples for each index of this axis; MAX_SAMPLES bounds their
    number in a part. If there are several parts, they are computed again in the backward pass, to
    save memory.
    """
    size = max(1, MAX_SAMPLES // each)
    parts = [*zip(*(x.split(size, 1) for x in whole), strict=True)]
    if len(parts) == 1:
        return part(*whole)
    found = [checkpoint(part, *x, use_reentrant=False, preserve_rng_state=False) for x in parts]
    return torch.cat(found, 1)


class DepthRange(ComponentConfig):
    """Range of depths in a plane sweep."""

    near: PositiveFloat
    """Least depth in the sweep, in world units. Published models use 1 (MVSplat) or 0.5
    (DepthSplat), with `views.frame: given`."""
    far: Far
    """Largest depth in the sweep, in world units. Published models use 100, but DepthSplat uses 200
    on DL3DV."""


class SweepEncoder(OfPixels, Encoder):
    """Base of encoders that predict depths by a plane sweep.

    They make a token for each pixel, or for each square of pixels.
    """

    # Views are matched in their order. With three or more, the mask of shifted windows depends on
    # the order too (released code).
    ordered_views = True
    writes = memory_fields("features", "grid")
    Config: type[DepthRange]
    config: DepthRange

    @classmethod
    @abstractmethod
    def multiple(cls, config: DepthRange) -> int:
        """Return the number of pixels of which height and width of images must be multiples.

        The windows of the transformer and the levels of the U-Nets require this.
        """

    @abstractmethod
    def predict(self, views: Views, near_BV: Tensor, far_BV: Tensor) -> Tensor:
        """Predict log depth and raw Gaussian per pixel: C numbers, (B, V, C, H, W).

        near, far: least and largest depth of the sweep, in world units.
        """

    @classmethod
    def problems(cls, config: DepthRange, context: RecipeContext) -> Iterable[Problem]:
        yield from super().problems(config, context)
        size = context.image_size
        multiple = cls.multiple(config)
        if size and any(side % multiple for side in size):
            nearest = [max(round(side / multiple), 1) * multiple for side in size]
            reason = (
                f"images of {size[0]} x {size[1]} (H x W) are not multiples of {multiple} pixels"
            )
            yield Problem("", reason, f"set data.image_size to {nearest}")

    def forward(self, views: Views) -> ImageMemory:
        """Return the memory with one token per pixel, or per square of pixels.

        Raises ValueError if the sides of images are not multiples of `multiple`.
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
