"""List the scenes to check in folders of photos and in data sets of DL3DV."""

from collections.abc import Iterator
from functools import partial

import numpy as np
from upath import UPath

from qgs.data.images import decode_depth, read_image
from qgs.data.photos import formats_of, read_listing
from qgs.data.photos.reader import PhotoFrame
from qgs.data.photos.source import folder_name, upright, whole_mask
from qgs.paths import read_file
from qgs_photos.datasets.dl3dv import find_scenes, scene_folder
from qgs_photos.datatools.findings import Finding
from qgs_photos.datatools.photos import Candidate, Photo, Photos


def photo_folders(root: UPath, wanted: str, images: str | None) -> Iterator[Candidate | Finding]:
    """Yield the scenes in `root`: `root` itself, its subfolders, or those in train/ and test/.

    wanted: name of a format, or auto. images: folder of photos inside each scene; None takes the
    format's default. A subfolder that lists no cameras, beside others that do, yields a warning.
    """
    if formats_of(root):
        yield from _listed(root, folder_name(root), wanted, images)
        return
    inside = sorted((item for item in root.iterdir() if item.is_dir()), key=str)
    scenes = [item for item in inside if formats_of(item)]
    for folder in scenes:
        yield from _listed(folder, folder.name, wanted, images)
    for folder in inside:
        if folder in scenes or folder.name.startswith("."):
            continue
        if scenes:
            reason = "the folder lists no cameras, and is not checked"
            fix = f"run `qgs data check {folder}` if it is another data set, else move it away"
            yield Finding(folder.name, reason, fix, severity="warning")
        elif folder.name in ("train", "test"):
            yield from photo_folders(folder, wanted, images)


def _listed(folder: UPath, name: str, wanted: str, images: str | None) -> Iterator[Candidate]:
    """Yield the scene of a folder in the format `wanted`, or nothing if it has another format.

    With "auto", the first format that the folder has is read.
    """
    held = formats_of(folder)
    kind = held[0] if wanted == "auto" else wanted
    if kind in held:
        yield Candidate(name, kind, partial(_photos, folder, kind, images))


def dl3dv_scenes(path: UPath, images: str | None) -> Iterator[Candidate]:
    """Yield the DL3DV scenes in `path`. Raises FileNotFoundError if there is no scene."""
    for name, place in find_scenes(path).items():
        # an archive is opened when its scene's turn comes
        yield Candidate(name, "dl3dv", partial(_archived_photos, place, images))


def _archived_photos(place: UPath, images: str | None) -> Photos:
    return _photos(scene_folder(place), "nerfstudio", images)


def _photos(folder: UPath, kind: str, images: str | None) -> Photos:
    listing = read_listing(folder, kind, images)
    photos = [
        Photo(
            listed=frame,
            read=partial(read_file, frame.path),
            maps={"mask": partial(_mask, frame), "depth map": partial(_depth, frame)},
            exists=frame.path in listing.present,
        )
        for frame in map(upright, listing.frames)
    ]
    return photos, ()


def _mask(frame: PhotoFrame) -> np.ndarray | None:
    return None if frame.mask is None else np.array(whole_mask(frame))


def _depth(frame: PhotoFrame) -> np.ndarray | None:
    return None if frame.depth is None else read_image(frame.depth, decode_depth)
