"""Real size of a scene, from a distance that the user has measured."""

import math
import re
from pathlib import Path
from typing import NamedTuple

from torch import Tensor

from qgs.contracts import Scene
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

    frame: index of the photo. place: x and y from 0 to 1, from the photo's left upper corner.
    """

    frame: int
    place: tuple[float, float] | None


def points_of(distance: Distance, photos: Scene) -> tuple[Point, Point]:
    """Return the two points of a distance.

    Raises ValueError for a point that does not exist, and for a length that is not above 0.
    """
    start, end, length = distance
    if start == end or not 0 < length < math.inf:
        raise ValueError(f"--scale-by needs two points and the metres between them: {distance}")
    return _point(start, photos), _point(end, photos)


def _point(text: str, photos: Scene) -> Point:
    name, x, y = _POINT.findall(text)[0]
    frames = {Path(photos.frame_name(frame)).name: frame for frame in range(len(photos))}
    if name not in frames:
        raise ValueError(f"--scale-by: no photo {name}; {did_you_mean(name, frames, 'photos')}")
    frame = frames[name]
    if not x:
        return Point(frame, None)
    height, width = photos.stored_size(frame) or photos.cameras.size
    place = int(x) / width, int(y) / height
    if max(place) >= 1:
        raise ValueError(f"--scale-by: {text} is outside of {width} x {height} pixels")
    return Point(frame, place)


def metres(distance: Distance, gaussians: Gaussians, cameras: Cameras, photos: Scene) -> float:
    """Return how many metres a unit of the world of Gaussians (1, G) is.

    cameras: of all photos in this world, (1, F). If both points are at one place, warns and returns
    1. Raises the errors of `points_of`.
    """
    start, end = (located(point, gaussians, cameras) for point in points_of(distance, photos))
    apart = float((start - end).norm())
    if not apart:
        warn_once("--scale-by has no effect: both points are at the same place")
        return 1.0
    return distance[-1] / apart


def located(point: Point, gaussians: Gaussians, cameras: Cameras) -> Tensor:
    """Return a point in the world of Gaussians (1, G) and all photos' cameras (1, F): (3,)."""
    camera = cameras[:, [point.frame]]
    centre = camera.c2w[0, 0, :3, 3]
    if point.place is None:
        return centre
    pixel = centre.new_tensor(point.place) * centre.new_tensor(camera.size).flip(0)
    column, row = pixel.long().tolist()
    depth = VIEWER(gaussians, camera).depth[0, 0, 0, row, column]
    x, y = pixel - 0.5
    return centre + depth * pixel_rays(camera, 0, y, x)


def in_metres(world: World, factor: float) -> World:
    """Return `world` of photos whose positions are multiplied by `factor`."""
    reference, scale = world
    return scaled(reference, factor), scale / factor
