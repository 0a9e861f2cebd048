"""Real size of a scene, from a distance that the user has measured."""

import math
import re
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from qgs.contracts import Scene
from qgs.data.images import CropResize
from qgs.geometry.poses import scaled
from qgs.types import Cameras, Gaussians, World
from qgs.wording import did_you_mean, warn_once
from qgs_photos.refine.sweeping import pixel_rays
from qgs_photos.viewing import VIEWER

Distance = tuple[str, str, float]
"""Two points and their distance in metres. A point is the name of a photo, which stands for its
camera, or NAME:X,Y for what the photo shows X pixels from its left and Y from its upper edge."""


_POINT = re.compile(r"^(.*?)(?::(\d+),(\d+))?$")


class Point(NamedTuple):
    """A point of a distance: the camera of a photo, or what is at a pixel (x, y) of the photo.

    frame: index of the photo. place: x and y from 0 to 1, from the left upper corner of the part of
    the photo that is used.
    """

    frame: int
    place: tuple[float, float] | None


def points_of(distance: Distance | None, photos: Scene) -> tuple[Point, Point] | None:
    """Return the two points of a distance; None without a distance.

    Raises ValueError for a point that does not exist, and for a length that is not above 0.
    """
    if not distance:
        return None
    start, end, length = distance
    if start == end or not 0 < length < math.inf:
        raise ValueError(f"--scale-by needs two points and the metres between them: {distance}")
    return _point(start, photos), _point(end, photos)


def _point(text: str, photos: Scene) -> Point:
    name, x, y = _POINT.findall(text)[0]
    names = [photos.frame_name(frame) for frame in range(len(photos))]
    found = [frame for frame, own in enumerate(names) if name in (own, Path(own).name)]
    if len(found) != 1:
        hint = did_you_mean(name, names, "photos")
        raise ValueError(f"--scale-by: {len(found)} photos are named {name}; {hint}")
    frame = found[0]
    if not x:
        return Point(frame, None)
    size = photos.cameras.size
    left, top, right, bottom = CropResize(photos.stored_size(frame) or size, size).box
    place = (float(x) - left) / (right - left), (float(y) - top) / (bottom - top)
    if not all(0 <= part < 1 for part in place):
        raise ValueError(
            f"--scale-by: {text} is outside of what is used of the photo: x from {left:.0f} to "
            f"{right:.0f}, y from {top:.0f} to {bottom:.0f}"
        )
    return Point(frame, place)


def metres(
    points: tuple[Point, Point],
    length: float,
    gaussians: Gaussians,
    cameras: Cameras,
    scale: Tensor,
) -> float:
    """Return how many metres a unit of the photos' world is.

    length: metres between the points. gaussians, cameras: (1, G), and of all photos (1, F), in a
    world that is `scale` times the photos' world. If a point shows nothing, or both are at one
    place, warns and returns 1.
    """
    start, end = (located(point, gaussians, cameras) for point in points)
    apart = float((end - start).norm())
    if not apart > 0:
        warn_once("--scale-by has no effect: a point shows nothing, or both are at one place")
        return 1.0
    return length / apart * float(scale)


def located(point: Point, gaussians: Gaussians, cameras: Cameras) -> Tensor:
    """Return a point in the world of Gaussians (1, G) and all photos' cameras (1, F): (3,).

    NaN for a pixel in which the Gaussians are mostly transparent.
    """
    camera = cameras[:, [point.frame]]
    centre = camera.c2w[0, 0, :3, 3]
    if point.place is None:
        return centre
    pixel = centre.new_tensor(point.place) * centre.new_tensor(camera.size).flip(0)
    column, row = pixel.long().tolist()
    render = VIEWER(gaussians, camera)
    depth, alpha = torch.cat([render.depth, render.alpha], 2)[0, 0, :, row, column]
    x, y = pixel - 0.5
    place = centre + depth * pixel_rays(camera, 0, y, x)
    return place.where(alpha > 0.5, math.nan)


def in_metres(world: World, factor: float) -> World:
    """Return `world` of photos whose positions are multiplied by `factor`."""
    reference, scale = world
    return scaled(reference, factor), scale / factor
