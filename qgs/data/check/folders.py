"""The scenes of photo folders and of DL3DV's archives, as candidates for a check."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import cast

from upath import UPath

from qgs.data.check.conventions import LLFF, OPENCV, OPENGL
from qgs.data.check.finding import Finding
from qgs.data.check.photo import Candidate, Photo
from qgs.data.dl3dv.layout import Place, find_scenes, scene_folder
from qgs.data.frames import PhotoFrame
from qgs.data.photos import folder_name
from qgs.data.readers import Format, formats_of, read_listing
from qgs.data.readers.listing import existing
from qgs.data.recognition import recognised

_CONVENTIONS = {"nerfstudio": OPENGL, "blender": OPENGL, "colmap": OPENCV, "llff": LLFF}


def photo_folder(
    folder: UPath, name: str, wanted: Format, images: str | None
) -> Iterator[Candidate]:
    """A candidate for each of the listings that a folder holds, or for the wanted one."""
    held = [kind for kind in formats_of(folder) if wanted in ("auto", kind)]
    for kind in held:
        label = f"{name} ({kind})" if len(held) > 1 else name
        photos = partial(_listed, folder, cast(Format, kind), images)
        yield Candidate(label, name, kind, _CONVENTIONS[kind], photos)


def photo_folders(root: UPath, wanted: Format, images: str | None) -> Iterator[Candidate | Finding]:
    """The scenes in `root`, which may be one itself, or hold them in train and test."""
    if formats_of(root):
        yield from photo_folder(root, folder_name(root), wanted, images)
        return
    inside = sorted((item for item in root.iterdir() if item.is_dir()), key=lambda item: item.name)
    scenes = {item.name: item for item in inside if formats_of(item)}
    for name, folder in scenes.items():
        yield from photo_folder(folder, name, wanted, images)
    for folder in inside:
        if folder.name in scenes or folder.name.startswith("."):
            continue
        if not scenes and folder.name in ("train", "test"):
            yield from photo_folders(folder, wanted, images)
        elif scenes:
            yield _no_scene(folder)


def _no_scene(folder: UPath) -> Finding:
    kind = recognised(folder).removeprefix("qgs/")
    if kind != "photos":
        reason = f"the folder is another data set ({kind}) and is not checked with the photos"
        return Finding(
            folder.name, f"{reason} beside it", f"run `qgs data check {folder}`", severity="warning"
        )
    reason = "the folder lists no cameras and is no scene"
    return Finding(folder.name, reason, "make poses for it, or move it away", severity="warning")


def dl3dv_scenes(path: UPath, images: str | None) -> list[Candidate]:
    """The scenes below `path`. Raises FileNotFoundError when there is none."""
    return [
        Candidate(name, name, "dl3dv", OPENGL, partial(_in_place, place, images))
        for name, place in find_scenes(path).items()
    ]


def _in_place(place: Place, images: str | None) -> list[Photo]:
    return _listed(scene_folder(place), "nerfstudio", images)


def _listed(folder: UPath, kind: Format, images: str | None) -> list[Photo]:
    return _with_files(read_listing(folder, kind, images).frames)


def _with_files(frames: Sequence[PhotoFrame]) -> list[Photo]:
    there = existing(frame.path for frame in frames if frame.name)
    masks = existing(frame.mask for frame in frames if frame.mask is not None)
    return [
        Photo(
            frame, frame.path.read_bytes, frame.path in there,
            frame.mask is None or frame.mask == frame.path or frame.mask in masks,
        )
        for frame in frames
    ]  # fmt: skip
