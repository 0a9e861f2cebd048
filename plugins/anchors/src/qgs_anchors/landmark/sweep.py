"""Sweep over depths: comparison of small windows of a photo with the other photos at each depth."""

import torch
from torch import Tensor

from qgs.geometry.constants import constant
from qgs.precision import full_precision
from qgs.types import Cameras, Views
from qgs_anchors.landmark.places import bilinear, rays_at, window

LEAST_SEEN = 0.5
"""Smallest share of a window's samples that another photo must see to count in `mismatch`."""
LEAST_DEPTH = 1e-3
"""Least depth at which a camera sees a point, world units."""


@full_precision
def mismatch(
    views: Views, view_N: Tensor, place_N2: Tensor, depth_D: Tensor, side: float, points: int
) -> tuple[Tensor, Tensor]:
    """Compare windows around points of photos with the other photos, at D depths.

    A window is a square of `side` pixels around one of N points, with `points` x `points` samples.
    Returns two tensors (B, N, D): differences and bools. A difference is the mean of |RGB - RGB of
    the other photo| over the samples, and over the photos that see at least half of the window at
    that depth. If no photo does, the difference is 0 and the bool False; otherwise the bool is
    True. Cameras and photos get gradients.
    """
    # A window, not a pixel: a single colour matches too many places.
    place_NP2 = window(place_N2, views.images, side, points)
    color_B3NP = bilinear(views.images, view_N, place_NP2)
    # All other photos at once: torch.compile would make a graph for each length of a loop.
    photos = views.cameras.shape[1]
    other_AN = (view_N + torch.arange(1, photos, device=view_N.device)[:, None]) % photos
    # Samples outside of the other photo do not count.
    at_BANDP2, seen_BANDP = reprojected(views.cameras, view_N, other_AN, place_NP2, depth_D)
    at_BXY2 = at_BANDP2.flatten(3, 4).flatten(1, 2)
    found_B3XY = bilinear(views.images, other_AN.flatten(), at_BXY2)
    found_B3ANDP = found_B3XY.unflatten(3, (-1, points**2)).unflatten(2, other_AN.shape)
    error_BANDP = (found_B3ANDP - color_B3NP[:, :, None, :, None]).abs().mean(1)
    error_BAND = (error_BANDP * seen_BANDP).sum(-1) / seen_BANDP.sum(-1).clamp_min(1)
    counts_BAND = seen_BANDP.to(error_BAND).mean(-1) >= LEAST_SEEN
    # A photo that sees less than half of the window does not count either.
    count_BND = counts_BAND.sum(1)
    return (error_BAND * counts_BAND).sum(1) / count_BND.clamp_min(1), count_BND > 0


def reprojected(
    cameras: Cameras, view_N: Tensor, other_AN: Tensor, place_NP2: Tensor, depth_D: Tensor
) -> tuple[Tensor, Tensor]:
    """Project P points in each of N photos, each at D depths, into A other photos.

    view, other: indices of the N photos, and of the other photos of each. place: x and y of the
    points, divided by the photo's width and height. Returns positions in the other photos
    (B, A, N, D, P, 2), and whether each is in front of the camera and inside the photo.
    """
    origin_BN3, direction_BNP3 = rays_at(cameras, view_N, place_NP2)
    c2w_BAN44 = cameras.c2w[:, other_AN]
    lens_BAN114 = cameras.intrinsics[:, other_AN, None, None]
    turn_BAN33 = c2w_BAN44[..., :3, :3]
    # A point at depth z, divided by z, is the ray's direction + the step between cameras / z.
    ray_BANP3 = direction_BNP3[:, None] @ turn_BAN33
    step_BAN13 = (origin_BN3[:, None] - c2w_BAN44[..., :3, 3])[..., None, :] @ turn_BAN33
    local = ray_BANP3[..., None, :, :] + step_BAN13[..., None, :, :] / depth_D[:, None, None]
    ahead_BANDP = local[..., 2] * depth_D[:, None] > LEAST_DEPTH
    slope = local[..., :2] / local[..., 2:].clamp_min(LEAST_DEPTH / depth_D.max())
    focal, middle = lens_BAN114.split(2, -1)
    place_BANDP2 = (slope * focal + middle) / constant(cameras.size[::-1], slope)
    # Outside of a photo, sampling would return colours of its edge.
    inside_BANDP = ((place_BANDP2 > 0) & (place_BANDP2 < 1)).all(-1)
    return place_BANDP2, ahead_BANDP & inside_BANDP
