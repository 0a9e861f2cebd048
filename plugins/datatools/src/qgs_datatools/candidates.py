"""What a check looks at: scenes, and their photos as they are listed, before anything is judged."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import cast

import numpy as np
from PIL import Image
from qgs.data.photos.formats import Format, formats_of, read_listing
from qgs.data.photos.frames import PhotoFrame, Size, undistorted
from qgs.data.photos.reading import existing
from upath import UPath

from qgs.data.dl3dv import find_scenes, scene_folder
from qgs.data.images import decode_rgb
from qgs.data.photos.source import folder_name
from qgs.data.recognition import recognised
from qgs_datatools.conventions import LLFF, OPENCV, OPENGL, Convention
from qgs_datatools.findings import Finding

_CONVENTIONS = {"nerfstudio": OPENGL, "blender": OPENGL, "colmap": OPENCV, "llff": LLFF}


@dataclass(frozen=True)
class Photo:
    """listed: as the listing says, with the faults that parsing found. read: the file's bytes.

    exists, mask_exists: whether the files that are listed are there.
    """

    listed: PhotoFrame
    read: Callable[[], bytes]
    exists: bool = True
    mask_exists: bool = True

    def picture(self, size: Size | None, side: int) -> tuple[np.ndarray, np.ndarray]:
        """The photo as a pinhole camera took it, RGB, with `side` pixels on its longer side.

        size: (H, W) of the file, which intrinsics go with where none is listed. Also the intrinsics
        (4,) in pixels of the picture. Raises OSError for a file that cannot be decoded.
        """
        frame = self.listed if self.listed.size else replace(self.listed, size=size)
        image = decode_rgb(io.BytesIO(self.read()), (1.0, 1.0, 1.0))
        scale = min(1.0, side / max(image.size))
        width, height = (max(1, round(extent * scale)) for extent in image.size)
        pixels = np.array(image.resize((width, height), Image.Resampling.LANCZOS))
        intrinsics = frame.at_size((height, width))
        if frame.lens is not None:
            pixels = undistorted(pixels, intrinsics, frame.lens)
        return pixels, np.array(intrinsics)


@dataclass(frozen=True)
class Candidate:
    """A scene to check, opened by `photos`, which raises ValueError or OSError for a bad listing.

    name: for people; scene: as evaluation indices name it. kind: its format. split: train or test,
    empty where the format knows no such folders.
    """

    name: str
    scene: str
    kind: str
    convention: Convention
    photos: Callable[[], Sequence[Photo]]
    split: str = ""


def photo_folders(root: UPath, wanted: Format, images: str | None) -> Iterator[Candidate | Finding]:
    """The scenes in `root`, which may be one itself, or hold them in train and test.

    wanted: the format of the listings to check. images: the folder of photos to read.
    """
    if formats_of(root):
        yield from _listings(root, folder_name(root), wanted, images)
        return
    inside = sorted((item for item in root.iterdir() if item.is_dir()), key=lambda item: item.name)
    scenes = [item for item in inside if formats_of(item)]
    for folder in scenes:
        yield from _listings(folder, folder.name, wanted, images)
    for folder in inside:
        if folder in scenes or folder.name.startswith("."):
            continue
        if scenes:
            yield _no_scene(folder)
        elif folder.name in ("train", "test"):
            yield from photo_folders(folder, wanted, images)


def _listings(folder: UPath, name: str, wanted: Format, images: str | None) -> Iterator[Candidate]:
    """A candidate for each of the listings that a folder holds, or for the wanted one."""
    held = [kind for kind in formats_of(folder) if wanted in ("auto", kind)]
    for kind in held:
        label = f"{name} ({kind})" if len(held) > 1 else name
        photos = partial(_photos, folder, cast(Format, kind), images)
        yield Candidate(label, name, kind, _CONVENTIONS[kind], photos)


def _no_scene(folder: UPath) -> Finding:
    kind = recognised(folder).removeprefix("qgs/")
    reason = "the folder lists no cameras and is no scene"
    fix = "make poses for it, or move it away"
    if kind != "photos":
        reason = f"the folder is another data set ({kind}) and is not checked with the photos"
        reason, fix = f"{reason} beside it", f"run `qgs data check {folder}`"
    return Finding(folder.name, reason, fix, severity="warning")


def dl3dv_scenes(path: UPath, images: str | None) -> list[Candidate]:
    """The scenes below `path`. Raises FileNotFoundError when there is none."""
    return [
        Candidate(
            name, name, "dl3dv", OPENGL,
            lambda place=place: _photos(scene_folder(place), "nerfstudio", images),
        )
        for name, place in find_scenes(path).items()
    ]  # fmt: skip


def _photos(folder: UPath, kind: Format, images: str | None) -> list[Photo]:
    frames = read_listing(folder, kind, images).frames
    there = existing(frame.path for frame in frames if frame.name)
    masks = existing(frame.mask for frame in frames if frame.mask is not None)
    return [
        Photo(
            frame, frame.path.read_bytes, frame.path in there,
            frame.mask is None or frame.mask == frame.path or frame.mask in masks,
        )
        for frame in frames
    ]  # fmt: skip
