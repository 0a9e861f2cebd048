"""Find poses and a focal length of the best two of few photos, from which COLMAP's mapping starts.

COLMAP's own choice of a first pair asks for more matches and parallax than few photos have.
"""

from collections.abc import Mapping
from itertools import combinations
from typing import Any, TypeAlias

import numpy as np
import pycolmap

from qgs_photos.poses.two_views import TwoViews, View, two_views

# Takes dictionaries for options, which its types do not say.
COLMAP: Any = pycolmap
Pairs: TypeAlias = Mapping[tuple[int, int], TwoViews]

FEW = 8
"""Largest number of photos whose pairs are searched by this module."""
LEAST_SCORE = 150
"""Least score of a pair that counts, see `TwoViews`. Of 200 real pairs 90 % reach it; of these 0 %
have errors above 20 degrees if the focal length is known, and 3 % if it is not."""
PARALLAX = 10
"""Least motion, in pixels, of a point at the median depth. Turns on the spot show up to 9."""
FLAT = 0.97
"""Share of matches that a plane explains, from which on a pair does not give the focal length."""
LEAST_DOUBT = 0.1
"""Least deviation of the logarithm of a focal length that matches of a pair give."""
NO_MATCHES = (
    "no two photos have enough matches. Take photos a step apart, so that each shows half of what "
    "the photo before shows"
)
ONE_PLACE = (
    "the photos match, but no two of them show the same from positions far enough apart. Take more "
    "photos, and walk around your subject: do not turn on the spot"
)
FLAT_THING = (
    "EXIF data give no focal length, and the photos show one flat thing, from which it cannot be "
    "found. Take photos of something with depth, or keep EXIF data in the files"
)


class RefusedError(Exception):
    """Error for photos that give no poses; its message says why."""


def beginning(database: Any) -> tuple[Any, list[str]]:
    """Return a model of the best two photos in an open database of COLMAP, and remarks.

    Focal lengths that EXIF does not give are set in the database. Raises RefusedError if no two
    photos give a pose.
    """
    found = pairs(database)
    if not found:
        raise RefusedError(NO_MATCHES)
    apart = {images: one for images, one in found.items() if one.focals[0] > PARALLAX * one.depth}
    if not apart:
        raise RefusedError(ONE_PLACE)
    deep = {images: pair for images, pair in apart.items() if pair.flat < FLAT}
    remarks = set_focals(database, deep)
    best = max(deep or apart, key=lambda images: found[images].score / found[images].depth ** 0.5)
    # all focal lengths are known now
    seen = views(database)
    pair = two_views(*(seen[image] for image in best))
    assert pair is not None
    return model(database, best, pair), remarks


def pairs(database: Any) -> Pairs:
    """Return what is found of all pairs, by the numbers of the photos in an open database."""
    seen = views(database)
    found = {(a, b): two_views(seen[a], seen[b]) for a, b in combinations(seen, 2)}
    return {images: pair for images, pair in found.items() if pair and pair.score >= LEAST_SCORE}


def views(database: Any) -> Mapping[int, View]:
    """Return the features of all photos that have any, by number."""
    found = dict[int, View]()
    for image in database.read_all_images():
        if not database.num_keypoints_for_image(image.image_id):
            continue
        camera = database.read_camera(image.camera_id)
        points = database.read_keypoints(image.image_id)[:, :2]
        descriptors = database.read_descriptors(image.image_id).data.astype(np.float32)
        found[image.image_id] = View(
            points=points - [camera.principal_point_x, camera.principal_point_y],
            descriptors=descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True),
            side=max(camera.width, camera.height),
            focal=camera.mean_focal_length() if camera.has_prior_focal_length else None,
        )
    return found


def set_focals(database: Any, found: Pairs) -> list[str]:
    """Set focal lengths that EXIF does not give to the mean of those of pairs; return remarks.

    Raises RefusedError if there are no pairs for this.
    """
    cameras = database.read_all_cameras()
    unknown = [camera for camera in cameras if not camera.has_prior_focal_length]
    if not unknown:
        return []
    if not found:
        raise RefusedError(FLAT_THING)
    seen = views(database)
    doubts = np.hypot([pair.focal_doubt for pair in found.values()], LEAST_DOUBT)
    focals = [pair.focals[0] / seen[one].side for (one, _), pair in found.items()]
    mean = np.exp(np.average(np.log(focals), weights=doubts**-2))
    for camera in unknown:
        camera.focal_length = mean * max(camera.width, camera.height)
        camera.has_prior_focal_length = True
        database.update_camera(camera)
    return [
        "EXIF data give no focal length of the photos: it was estimated as "
        f"{mean:.2f} times their longer side, and may be wrong by {2 * doubts.min():.0%}"
    ]


def model(database: Any, images: tuple[int, int], pair: TwoViews) -> Any:
    """Return a model of two photos. The median depth of its points in the first photo is 1."""
    built = COLMAP.Reconstruction()
    scale = 1 / pair.depth
    second = np.concatenate([pair.rotation, scale * pair.translation[:, None]], 1)
    for image, focal, pose in zip(images, pair.focals, (np.eye(3, 4), second), strict=True):
        photo = database.read_image(image)
        camera = database.read_camera(photo.camera_id)
        camera.focal_length = focal
        if not built.exists_camera(camera.camera_id):
            built.add_camera_with_trivial_rig(camera)
        points = database.read_keypoints(image)[:, :2].astype(float)
        photo.points2D = COLMAP.Point2DList([COLMAP.Point2D(point) for point in points])
        built.add_image_with_trivial_frame(photo, COLMAP.Rigid3d(pose))
    for point, features in zip(scale * pair.points, pair.indices, strict=True):
        track = COLMAP.Track()
        for image, feature in zip(images, features, strict=True):
            track.add_element(image, feature)
        built.add_point3D(point, track)
    return built
