"""Where the scenes of DL3DV lie.

A scene is an archive {hash}.zip or a folder {hash}, directly under the data set's folder or in one
of its subsets (1K, 2K, ...). transforms.json and the photos (images, images_4, images_8) lie at its
top; in the benchmark in gaussian_splat/ or nerfstudio/ below it; in an archive also in the one
folder that this holds.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from typing import TypeAlias, cast

from upath import UPath

from qgs.data.archives import ArchivePath

_log = logging.getLogger(__name__)

LISTING = "transforms.json"
_INSIDE = ("", "gaussian_splat", "nerfstudio")
_DEPTH = 2  # folders between the data set's and a scene

Place: TypeAlias = UPath | ArchivePath
"""An archive's top or a folder: what a scene is published as."""


def find_scenes(path: UPath) -> dict[str, Place]:
    """The scenes below `path` by name, sorted; archives are not opened.

    `path` may be a scene itself. A scene that is there as a folder and as an archive is read from
    the folder; such scenes are counted and named in a warning. Raises FileNotFoundError when there
    is none.
    """
    if not path.exists():
        raise FileNotFoundError(
            f"the DL3DV folder {path} does not exist: give the folder that holds 1K/, {{hash}}.zip "
            "or {hash}/"
        )
    scenes: dict[str, Place] = {}
    again: set[str] = set()
    for name, place in sorted(_places(path, _DEPTH), key=lambda item: (item[0], str(item[1]))):
        if name in scenes:
            again.add(name)
        if name not in scenes or isinstance(scenes[name], ArchivePath):
            scenes[name] = place
    if not scenes:
        inside = ", ".join(sorted(item.name for item in path.iterdir())[:8]) or "nothing"
        raise FileNotFoundError(
            f"{path} holds no scenes of DL3DV: expected {{hash}}.zip or {{hash}}/{LISTING}, also "
            f"in folders such as 1K/, found {inside}"
        )
    if again:
        _log.warning(
            "%d scenes of %s are there more than once, as folders or archives; one of each is "
            "read: %s", len(again), path, ", ".join(f"{n} ({scenes[n]})" for n in sorted(again)),
        )  # fmt: skip
    return scenes


def _places(path: UPath, depth: int) -> Iterator[tuple[str, Place]]:
    if path.suffix == ".zip" and path.is_file():
        yield path.stem, ArchivePath(path)
    elif not path.is_dir():
        return
    elif _holds_listing(path):
        yield path.name, path
    elif depth:
        for item in path.iterdir():
            if not item.name.startswith("."):
                yield from _places(item, depth - 1)


def _holds_listing(folder: UPath) -> bool:
    return any((folder / inside / LISTING).is_file() for inside in _INSIDE)


def scene_folder(place: Place) -> UPath:
    """The folder of a scene that holds transforms.json.

    Raises FileNotFoundError when there is none, ValueError when an archive holds several scenes or
    cannot be read.
    """
    tops: list[Place] = [place]
    if isinstance(place, ArchivePath):
        tops += [item for item in place.iterdir() if item.is_dir() and item.name not in _INSIDE]
    found = [top for top in tops if _within(top)]
    if not found:
        raise FileNotFoundError(
            f"{place} holds no {LISTING}, at its top or in gaussian_splat/ or nerfstudio/: "
            "download the scene again, or remove it"
        )
    if len(found) > 1:
        raise ValueError(
            f"{place} holds {len(found)} scenes, {found[0].name} and {found[1].name} among them, "
            "and one is expected in an archive: unpack it, and give the folder"
        )
    return cast(UPath, _within(found[0])[0])


def _within(top: Place) -> list[Place]:
    folders = [top / inside if inside else top for inside in _INSIDE]
    return [folder for folder in folders if (folder / LISTING).is_file()]
