"""Find poses of two to eight photos, for which COLMAP's mapping alone finds too little."""

from collections.abc import Mapping
from itertools import combinations
from typing import Any

import numpy as np
import pycolmap

from qgs_photos.poses.two_views import TwoViews, View, two_views

# Takes dictionaries for options, which its types do not say.
COLMAP: Any = pycolmap


def views(database: Any) -> Mapping[int, View]:
    """Return the features of all photos in an open database of COLMAP, by number of the photo."""
    found = dict[int, View]()
    for image in database.read_all_images():
        camera = database.read_camera(image.camera_id)
        points = database.read_keypoints(image.image_id)[:, :2]
        descriptors = database.read_descriptors(image.image_id).data.astype(np.float32)
        descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
        found[image.image_id] = View(
            points=points - [camera.principal_point_x, camera.principal_point_y],
            descriptors=descriptors,
            side=max(camera.width, camera.height),
            focal=camera.mean_focal_length() if camera.has_prior_focal_length else None,
        )
    return found


def refusal(pair: TwoViews | None) -> str | None:
    """Return why a pair of photos gives no pose; None if it does."""
    if pair is None or pair.score < 40:
        return "they have too few matching features"
    return None


def model(database: Any, images: tuple[int, int], pair: TwoViews) -> Any:
    """Return a model of two photos. The median depth of its points in the first photo is 1.

    images: numbers of the photos in the open database of COLMAP.
    """
    built = COLMAP.Reconstruction()
    scale = 1 / np.median(pair.points[:, 2])
    second = np.concatenate([pair.rotation, scale * pair.translation[:, None]], 1)
    for place, pose in enumerate((np.eye(3, 4), second)):
        image = database.read_image(images[place])
        camera = database.read_camera(image.camera_id)
        camera.focal_length = pair.focals[place]
        if not built.exists_camera(camera.camera_id):
            built.add_camera_with_trivial_rig(camera)
        points = database.read_keypoints(image.image_id)[:, :2].astype(float)
        image.points2D = COLMAP.Point2DList([COLMAP.Point2D(point) for point in points])
        built.add_image_with_trivial_frame(image, COLMAP.Rigid3d(pose))
    for point, features in zip(scale * pair.points, pair.indices, strict=True):
        track = COLMAP.Track()
        for image, feature in zip(images, features, strict=True):
            track.add_element(image, feature)
        built.add_point3D(point, track)
    return built
