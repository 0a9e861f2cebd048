"""`datasets/dl3dv`: read the scenes of DL3DV from archives or folders."""

import re
import zipfile
from collections.abc import Iterator
from functools import partial
from typing import Any

from pydantic import NonNegativeInt
from upath import UPath

from qgs.data.photos import formats_of
from qgs.data.photos.source import PhotoScene, PhotosConfig
from qgs.data.scenes import BoundedCache, LazySource
from qgs.paths import opened_path, read_file, read_json
from qgs.wording import listed, warn_once
from qgs_photos.datasets.chunks import ManyScenesConfig, first_scenes

LISTING = "transforms.json"
# Folders of a scene that may hold the listing.
_INSIDE = ("", "gaussian_splat", "nerfstudio")
# Folders between the data set's and a scene.
_DEPTH = 2
_HASH = re.compile(r"[0-9a-f]{64}")


class Dl3dvConfig(ManyScenesConfig):
    """Options of `datasets/dl3dv`."""

    path: str
    """Folder or fsspec URL of the data set, of a part of it, or of one scene. A relative folder
    starts at the working directory."""
    images: str | None = None
    """Folder of photos inside each scene, such as images_4. null takes the folder with the
    largest photos."""
    test_scenes: str | None = None
    """File that names the test scenes: an evaluation index, a JSON list, or text with a name on
    each line. Training uses all other scenes. null names no test scenes: training uses all
    scenes."""
    holdout: NonNegativeInt = 0
    """A number N above 0 holds out every Nth frame of a scene for evaluation, from frame N // 2
    on. 0 holds out none."""


class Dl3dvSource(LazySource):
    """Source of DL3DV's scenes, read from folders, or from archives without unpacking them.

    Without `test_scenes`, all scenes are for training; if `holdout` is set, the held-out frames of
    these scenes are for evaluation. Intrinsics from transforms.json are scaled to the size of the
    photos. Images and test scenes that do not exist are left out; a warning counts and names them.
    """

    name = "dl3dv"
    Config = Dl3dvConfig
    not_in_protocol = frozenset({"path", "test_scenes", "max_scenes"})
    split_options = frozenset({"holdout"})

    def __init__(self, config: Dl3dvConfig) -> None:
        super().__init__(config)
        places = find_scenes(opened_path(config.path))
        train = places
        test = places if config.holdout else {}
        if config.test_scenes is not None:
            named = read_scene_list(opened_path(config.test_scenes))
            absent = [name for name in named if name not in places]
            test = {name: places[name] for name in named if name in places}
            train = {name: place for name, place in places.items() if name not in test}
            if absent:
                count = f"{len(absent)} of {len(named)}"
                warn_once(f"{count} test scenes do not exist and are left out: {listed(absent, 3)}")
        same = config.model_dump(include={"path", "images", "holdout", "background", "image_size"})
        photos = PhotosConfig(format="nerfstudio", **same)
        opener = partial(_opened, config=photos, cache=BoundedCache(0))
        self.splits = {
            "train": first_scenes(train, config, opener),
            "test": first_scenes(test, config, opener),
        }

    @classmethod
    def recognises(cls, path: UPath) -> bool:
        """Return whether `path`, or a folder in it such as 1K, holds archives or scenes of DL3DV.

        The folder of a scene is named by a hash, or has the layout of DL3DV's benchmark. A folder
        in a format that `qgs/photos` reads is not recognised.
        """
        if path.is_file():
            return path.suffix == ".zip"
        return not formats_of(path) and any(
            place.suffix == ".zip" or _HASH.fullmatch(name) or not formats_of(place)
            for name, place in _places(path, _DEPTH)
        )


def _opened(name: str, place: UPath, **options: Any) -> PhotoScene:
    return PhotoScene(name, scene_folder(place), **options)


def find_scenes(path: UPath) -> dict[str, UPath]:
    """Return the folder or archive of each scene at or below `path`, by the scene's name.

    If a scene has a folder and an archive, the folder is returned. Raises FileNotFoundError if
    there is no scene.
    """
    if not path.exists():
        raise FileNotFoundError(
            f"the DL3DV folder {path} does not exist: give the folder that holds 1K/, {{hash}}.zip "
            "or {hash}/"
        )
    found = sorted(_places(path, _DEPTH), key=lambda item: (item[1].suffix == ".zip", str(item[1])))
    # the first of a name wins
    scenes = dict(reversed(found))
    if not scenes:
        inside = listed(sorted(item.name for item in path.iterdir())) or "nothing"
        raise FileNotFoundError(
            f"{path} holds no scenes of DL3DV: expected {{hash}}.zip or {{hash}}/{LISTING} in "
            f"it or in folders such as 1K/, found {inside}"
        )
    if len(found) > len(scenes):
        warn_once(
            f"{len(found) - len(scenes)} scenes of {path} exist more than once, as folders or "
            "archives; one copy of each is read, a folder before an archive"
        )
    return dict(sorted(scenes.items()))


def _places(path: UPath, depth: int) -> Iterator[tuple[str, UPath]]:
    if path.suffix == ".zip" and path.is_file():
        yield path.stem, path
    elif not path.is_dir():
        return
    elif any((path / inside / LISTING).is_file() for inside in _INSIDE):
        yield path.name, path
    elif depth:
        for item in path.iterdir():
            if not item.name.startswith("."):
                yield from _places(item, depth - 1)


def scene_folder(place: UPath) -> UPath:
    """Return the folder with transforms.json inside a scene's folder or archive.

    Raises FileNotFoundError if there is none, ValueError for an archive that cannot be read.
    """
    tops = [place]
    if place.suffix == ".zip":
        try:
            # open as long as paths below it live
            top = UPath(f"zip:///::{place}")
            folders = (item for item in top.iterdir() if item.is_dir())
            tops = [top, *(item for item in folders if item.name not in _INSIDE)]
        except (zipfile.BadZipFile, OSError) as error:
            raise ValueError(
                f"{place} is not a zip archive, or is cut off ({error}): download it again"
            ) from error
    for top in tops:
        for inside in _INSIDE:
            folder = top / inside if inside else top
            if (folder / LISTING).is_file():
                return folder
    raise FileNotFoundError(
        f"{place} holds no {LISTING}, at its top or in gaussian_splat/ or nerfstudio/: download "
        "the scene again, or remove it"
    )


def read_scene_list(file: UPath) -> list[str]:
    """Read names of scenes from a JSON mapping (its keys), a JSON list, or lines of text.

    Raises FileNotFoundError if the file does not exist, ValueError if it names no scene.
    """
    if not file.is_file():
        raise FileNotFoundError(f"the list of scenes {file} does not exist: correct its name")
    if file.suffix == ".json":
        names = read_json(file, "correct it")
        if not isinstance(names, dict | list) or not all(isinstance(name, str) for name in names):
            raise ValueError(
                f"{file} must hold names of scenes in JSON: write a list of names, or a mapping "
                "whose keys are the names"
            )
    else:
        lines = read_file(file).decode("utf-8-sig").splitlines()
        names = [name for line in lines if (name := line.partition("#")[0].strip())]
    if not names:
        raise ValueError(f"the list of scenes {file} names no scene: write one name on each line")
    return list(dict.fromkeys(names))
