"""COLMAP: a sparse model, text or binary, beside a folder of photos."""

from __future__ import annotations

import math
from pathlib import PurePosixPath
from typing import TYPE_CHECKING

import numpy as np
from upath import UPath

from qgs.data.lenses import Fisheye, Lens, RadialTangential, bending
from qgs.data.photos.colmap_model import files_of, load_model
from qgs.data.photos.frames import Fault, Intrinsics, PhotoFrame
from qgs.data.photos.reading import Listing, image_folder

if TYPE_CHECKING:
    import pycolmap

LISTING = "sparse/0/{cameras,images}.{bin,txt}"
_PLACES = ("sparse/0", "sparse", "colmap/sparse/0", ".")
_PINHOLE = ("SIMPLE_PINHOLE", "PINHOLE")
_LENSES: dict[str, type[Lens]] = {
    "SIMPLE_RADIAL": RadialTangential,
    "RADIAL": RadialTangential,
    "OPENCV": RadialTangential,
    "OPENCV_FISHEYE": Fisheye,
    "SIMPLE_RADIAL_FISHEYE": Fisheye,
    "RADIAL_FISHEYE": Fisheye,
}
_FOCAL_AND_CENTRE = ("f", "fx", "fy", "cx", "cy")


def recognises(folder: UPath) -> bool:
    """Whether `folder` holds this format."""
    return _model(folder) is not None


def _model(folder: UPath) -> UPath | None:
    return next((folder / place for place in _PLACES if files_of(folder / place)), None)


def read(folder: UPath, images: str | None) -> Listing:
    """The posed images by name; a binary model before a text one, in the first of `_PLACES`.

    Of a folder of photos and its scaled copies, the least reduced is read. Raises as `load_model`
    and `image_folder`.
    """
    model = _model(folder)
    assert model is not None
    reconstruction, names = load_model(model)
    photos = image_folder(folder, images)
    frames = [
        _frame(photos, names[number], image, reconstruction.cameras[image.camera_id])
        for number, image in reconstruction.images.items()
        if image.has_pose
    ]
    return Listing(model, sorted(frames, key=lambda frame: frame.name))


def _frame(photos: UPath, name: str, image: pycolmap.Image, camera: pycolmap.Camera) -> PhotoFrame:
    intrinsics, lens, faults = _camera(camera)
    return PhotoFrame(
        name=str(PurePosixPath(photos.name, name)),
        path=photos / name,
        c2w=_c2w(image.cam_from_world()),
        intrinsics=intrinsics,
        size=(camera.height, camera.width) if camera.height and camera.width else None,
        lens=lens,
        faults=faults,
    )


def _c2w(cam_from_world: pycolmap.Rigid3d) -> np.ndarray:
    """OpenCV camera-to-world; COLMAP gives world-to-camera, with a quaternion of any length."""
    import pycolmap

    quaternion = np.array(cam_from_world.rotation.quat)
    length = np.linalg.norm(quaternion)
    c2w = np.eye(4)
    if not 0 < length < math.inf:
        return np.full((4, 4), np.nan)
    rotation = pycolmap.Rotation3d(quaternion / length).matrix().T
    c2w[:3, :3] = rotation
    c2w[:3, 3] = -rotation @ cam_from_world.translation
    return c2w


def _camera(camera: pycolmap.Camera) -> tuple[Intrinsics, Lens | None, tuple[Fault, ...]]:
    """Intrinsics and lens of a camera of COLMAP's models 0 to 5, 8 and 9."""
    parameters = dict(zip(camera.params_info.split(", "), map(float, camera.params), strict=True))
    model = camera.model_name
    if model not in (*_PINHOLE, *_LENSES):
        known = ", ".join((*_PINHOLE, *_LENSES))
        fault = Fault(
            f"the camera model {model} is not known",
            f"undistort with `colmap image_undistorter`, or use one of {known}",
        )
        return (math.nan, math.nan, math.nan, math.nan), None, (fault,)
    focal = parameters.get("f", math.nan)
    fx, fy = parameters.get("fx", focal), parameters.get("fy", focal)
    bends = {
        "k1" if key == "k" else key: value
        for key, value in parameters.items()
        if key not in _FOCAL_AND_CENTRE
    }
    lens = None if model in _PINHOLE else bending(_LENSES[model](**bends))
    return (fx, fy, parameters["cx"], parameters["cy"]), lens, ()
