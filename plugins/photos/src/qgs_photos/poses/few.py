"""Find poses and a focal length of the best two of few photos, from which COLMAP's mapping starts.

COLMAP's own choice of a first pair asks for more matches and parallax than few photos have.
"""

from collections.abc import Mapping
from itertools import combinations
from typing import Any

import numpy as np

from qgs_photos.poses.two_views import COLMAP, USUAL, Links, TwoViews, View, linked, two_views

# By the numbers of two photos.
Linked = Mapping[tuple[int, int], Links]
Pairs = dict[tuple[int, int], TwoViews]

SEARCHED = 8
"""Largest number of photos whose pairs are searched by this module."""
PARALLAX = 10
"""Least motion, in pixels, of a point at the median depth. Turns on the spot show up to 9."""
LENSES = (0.6, 3.7)
"""Range of the focal lengths that a pair gives, in units of the longer side. Photos of two lenses
seem to have one beyond; so do 5 % of real pairs, nearly all of a lens of 3.0."""
MOST_DOUBT = 0.97 * USUAL[1]
"""Deviation of the logarithm of a focal length from which on matches say nothing about it, as those
of a photo with its mirror image."""
LEAST_DOUBT = 0.1
"""Least deviation of the logarithm of a focal length that matches of a pair give."""
BETTER = 50
"""Gain in score by another focal length from which on those of EXIF are not used. If EXIF is right
to 4 %, the gain reaches 40; with focal lengths twice or half as long, half of real pairs exceed 50,
and the median error of their poses falls from 13 to 2 degrees."""
NO_MATCHES = (
    "no two photos have enough matches. Take photos a step apart, so that each shows half of what "
    "the photo before shows"
)
ONE_PLACE = (
    "the photos match, but no two of them show the same from positions far enough apart. Take more "
    "photos, and walk around your subject: do not turn on the spot"
)
NO_FOCAL = (
    "EXIF data give no focal length that fits the photos, and it cannot be found: the photos show "
    "one flat thing, or have different lenses. Take photos of something with depth with one lens, "
    "or keep EXIF data in the files"
)


class RefusedError(Exception):
    """Error for photos that give no poses; its message says why."""


def beginning(database: Any, links: Linked) -> tuple[Any, list[str], bool]:
    """Return a model of the best two photos in an open database of COLMAP, remarks, and a switch.

    The switch is True if EXIF gives no focal length, or one that does not fit the photos. Focal
    lengths that it does not give are set in the database. Raises RefusedError if no two photos give
    a pose.
    """
    cameras = database.read_all_cameras()
    estimated = not any(camera.has_prior_focal_length for camera in cameras)
    remarks = set_focals(database, links)
    seen = views(database)
    found = pairs(seen, links)
    (one, other), pair = max(
        found.items(),
        key=lambda item: (
            item[1].flat < links[item[0]].limits.flat,
            item[1].score / item[1].depth ** 0.5,
        ),
    )
    free = None if estimated else two_views(seen[one], seen[other], links[one, other], USUAL[1])
    if free and free.score > pair.score + BETTER:
        # what EXIF says is wrong: do without
        for camera in cameras:
            camera.has_prior_focal_length = False
            database.update_camera(camera)
        return beginning(database, links)
    return model(database, (one, other), pair), remarks, estimated


def pairs(seen: Mapping[int, View], links: Linked) -> Pairs:
    """Return pairs of photos far enough apart. Raises RefusedError if there are none.

    seen: features of all photos, by number.
    """
    sure = Pairs()
    for (one, other), matches in links.items():
        pair = two_views(seen[one], seen[other], matches)
        if pair and pair.score >= matches.limits.score:
            sure[one, other] = pair
    if not sure:
        raise RefusedError(NO_MATCHES)
    apart = {
        images: pair for images, pair in sure.items() if pair.focals[0] > PARALLAX * pair.depth
    }
    if not apart:
        raise RefusedError(ONE_PLACE)
    return apart


def described(database: Any) -> Linked:
    """Return the matches of all pairs of photos by their descriptors."""
    found = dict[int, Any]()
    for image in database.read_all_images():
        if database.num_keypoints_for_image(image.image_id):
            own = database.read_descriptors(image.image_id).data.astype(np.float32)
            found[image.image_id] = own / np.linalg.norm(own, axis=1, keepdims=True)
    return {(a, b): linked(found[a], found[b]) for a, b in combinations(found, 2)}


def views(database: Any) -> Mapping[int, View]:
    """Return the features of all photos, by number."""
    found = dict[int, View]()
    for image in database.read_all_images():
        camera = database.read_camera(image.camera_id)
        points = database.read_keypoints(image.image_id)[:, :2]
        found[image.image_id] = View(
            points=points - [camera.principal_point_x, camera.principal_point_y],
            side=max(camera.width, camera.height),
            focal=camera.mean_focal_length() if camera.has_prior_focal_length else None,
        )
    return found


def set_focals(database: Any, links: Linked) -> list[str]:
    """Set focal lengths that EXIF does not give, and return remarks.

    Photos without one are taken to have the lens of those with one. Without any, the mean of those
    that pairs give is taken. Raises RefusedError if no pair gives one.
    """
    cameras = database.read_all_cameras()
    unknown = [camera for camera in cameras if not camera.has_prior_focal_length]
    if not unknown:
        return []
    seen = views(database)
    told = [(view.focal / view.side, LEAST_DOUBT) for view in seen.values() if view.focal]
    if not told:
        for images, pair in pairs(seen, links).items():
            focal = pair.focals[0] / seen[images[0]].side
            solid = pair.flat < links[images].limits.flat and pair.focal_doubt < MOST_DOUBT
            if solid and LENSES[0] < focal < LENSES[1]:
                told.append((focal, np.hypot(pair.focal_doubt, LEAST_DOUBT)))
    if not told:
        raise RefusedError(NO_FOCAL)
    focals, doubts = np.transpose(told)
    mean = np.exp(np.average(np.log(focals), weights=doubts**-2))
    for camera in unknown:
        camera.focal_length = mean * max(camera.width, camera.height)
        camera.has_prior_focal_length = True
        database.update_camera(camera)
    return [
        f"the focal length was estimated as {mean:.2f} times their longer side for photos whose "
        f"EXIF data give none that fits, and may be wrong by {2 * doubts.min():.0%}"
    ]


def model(database: Any, images: tuple[int, int], pair: TwoViews) -> Any:
    """Return a model of two photos. The median depth of its points in the first photo is 1."""
    built = COLMAP.Reconstruction()
    scale = 1 / pair.depth
    second = np.c_[pair.rotation, scale * pair.translation]
    for image, focal, pose in zip(images, pair.focals, (np.eye(3, 4), second), strict=True):
        photo = database.read_image(image)
        camera = database.read_camera(photo.camera_id)
        camera.focal_length = focal
        if not built.exists_camera(camera.camera_id):
            built.add_camera_with_trivial_rig(camera)
        points = database.read_keypoints(image)[:, :2].astype(float)
        photo.points2D = [COLMAP.Point2D(point) for point in points]
        built.add_image_with_trivial_frame(photo, COLMAP.Rigid3d(pose))
    for point, features in zip(scale * pair.points, pair.indices, strict=True):
        track = COLMAP.Track()
        for image, feature in zip(images, features, strict=True):
            track.add_element(image, feature)
        built.add_point3D(point, track)
    return built
