"""`qgs/photos`: a folder of photos with their cameras, or a folder of such folders."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import ClassVar

from pydantic import Field
from upath import UPath

from qgs.contracts import Scene, SceneSource, Split
from qgs.data.lazy import BoundedCache, LazyScenes, warn_once
from qgs.data.paths import opened_path
from qgs.data.photos.formats import Format, formats_of, read_listing
from qgs.data.photos.frames import PhotoFrame, require_sound
from qgs.data.photos.reading import Listing, existing
from qgs.data.photos.scene import Development, PhotoScene, pixel_cache
from qgs.types import Cameras, Views

_OPEN_SCENES = 64


class PhotosConfig(SceneSource.Config):
    """Options of `qgs/photos`.

    path: folder of one scene, or of folders of scenes, or with such folders in train and test; an
    absolute path, one relative to the working directory, or an fsspec URL. format: how cameras are
    listed; auto takes the first that a folder holds of nerfstudio (transforms.json), blender
    (transforms_train.json), colmap (a sparse model) and llff (poses_bounds.npy). images: folder of
    photos to read instead of the listed one, such as images_4. holdout: every n-th frame is kept
    for evaluation, from frame n // 2 on; 0 for none; a listing's own split goes first. max_frames:
    only the first frames of a listing, 0 for all. background: RGB behind transparent pixels.
    depth_unit: world units per number of a depth map (nerfstudio: 0.001, for millimetres).
    """

    split_options: ClassVar[frozenset[str]] = frozenset({"holdout", "max_frames"})

    path: str
    format: Format = "auto"
    images: str | None = None
    holdout: int = Field(default=8, ge=0)
    max_frames: int = Field(default=0, ge=0)
    background: tuple[float, float, float] = (1.0, 1.0, 1.0)
    depth_unit: float = Field(default=1e-3, gt=0)


class PhotosSource(SceneSource):
    """Photos of one scene or of many; both splits are the same scenes, with held-out frames.

    Only where the folder has scenes in `train` and `test`, the splits are those. A single scene is
    opened at once; of many, each is when it is asked for. Poses and intrinsics that cannot be meant
    are refused, photos that do not exist are left out, counted and named in a warning.
    """

    name = "photos"
    Config = PhotosConfig

    def __init__(self, config: PhotosConfig) -> None:
        super().__init__(config)
        self._scenes = _scenes(config, opened_path(config.path))
        single = self._scenes["train"]
        if self._scenes["test"] is single and len(single) == 1:
            _ = single[0].cameras

    @property
    def missing(self) -> list[str]:
        """Photos that a listing names and that do not exist, of the scenes opened so far."""
        scenes = dict.fromkeys(self._scenes.values())
        return [path for opened in scenes for paths in opened.missing.values() for path in paths]

    def scenes(self, split: Split) -> Sequence[Scene]:
        """See `SceneSource`."""
        return self._scenes[split]

    def names(self, split: Split) -> Sequence[str]:
        """See `SceneSource`."""
        return self._scenes[split].names


class PhotoScenes(LazyScenes):
    """Scenes by folder, opened when asked for; the last ones stay open.

    missing: by folder that was opened, the listed photos that do not exist.
    """

    def __init__(self, folders: Mapping[str, UPath], config: PhotosConfig) -> None:
        self._folders, self._config = list(folders.items()), config
        self._opened: BoundedCache[PhotoScene] = BoundedCache(_OPEN_SCENES, _one)
        self._pixels = pixel_cache()
        self.missing: dict[str, list[str]] = {}

    def __len__(self) -> int:
        return len(self._folders)

    @property
    def names(self) -> list[str]:
        """Names of the scenes; none is opened."""
        return [name for name, _ in self._folders]

    def scene(self, place: int) -> PhotoScene:
        """See `LazyScenes`."""
        name, folder = self._folders[place]
        return self._opened.get(name, lambda: self._open(name, folder))

    def _open(self, name: str, folder: UPath) -> PhotoScene:
        config = self._config
        frames, self.missing[name] = present_frames(folder, config.format, config.images)
        frames = frames[: config.max_frames or None]
        development = Development(config.image_size, config.background, config.depth_unit)
        held_out = held_out_frames(frames, config.holdout)
        scene = PhotoScene(name, frames, development, held_out, self._pixels)
        scene.missing = self.missing[name]
        return scene


def _one(scene: PhotoScene) -> int:
    return 1


def _scenes(config: PhotosConfig, root: UPath) -> Mapping[Split, PhotoScenes]:
    """The scenes of both splits; raises FileNotFoundError when `root` holds none."""
    if root.is_dir() and not formats_of(root):
        train, test = (_folders(root / part, config) for part in ("train", "test"))
        if train and test:
            return {"train": PhotoScenes(train, config), "test": PhotoScenes(test, config)}
        inside = _folders(root, config)
        if inside:
            scenes = PhotoScenes(inside, config)
            return {"train": scenes, "test": scenes}
    single = PhotoScenes({folder_name(root): root}, config)
    return {"train": single, "test": single}


def _folders(root: UPath, config: PhotosConfig) -> dict[str, UPath]:
    """The folders in `root` that hold a scene in the wanted format, by name."""
    if not root.is_dir():
        return {}
    inside = sorted((item for item in root.iterdir() if item.is_dir()), key=lambda item: item.name)
    held = {folder.name: formats_of(folder) for folder in inside}
    wanted = [
        folder for folder in inside
        if (config.format in held[folder.name] if config.format != "auto" else held[folder.name])
    ]  # fmt: skip
    left = [folder.name for folder in inside if folder not in wanted]
    if wanted and left:
        warn_once(
            f"{len(left)} of {len(inside)} folders in {root} hold no photos with cameras and are "
            f"left out: {', '.join(left)}"
        )
    return {folder.name: folder for folder in wanted}


def folder_name(folder: UPath) -> str:
    """The name of the scene in `folder`."""
    return folder.resolve().name or "photos"


def held_out_frames(frames: Sequence[PhotoFrame], holdout: int) -> tuple[int, ...]:
    """The frames that a listing's split keeps from training; else every `holdout`-th one."""
    if any(frame.split for frame in frames):
        return tuple(i for i, frame in enumerate(frames) if frame.split == "test")
    return tuple(range(holdout // 2, len(frames), holdout)) if holdout else ()


def present_frames(
    folder: UPath, format: Format = "auto", images: str | None = None
) -> tuple[list[PhotoFrame], list[str]]:
    """The frames whose image files exist, and the paths of the others, which are also logged.

    Frames that belong to none of the listing's splits are left out, which is logged too.
    Raises FileNotFoundError when fewer than two images or a mask do not exist, ValueError for
    poses and intrinsics that cannot be meant.
    """
    listing = read_listing(folder, format, images)
    require_sound(listing.file, listing.frames)
    frames = _used(listing)
    there = existing(frame.path for frame in frames)
    present = [frame for frame in frames if frame.path in there]
    missing = [str(frame.path) for frame in frames if frame.path not in there]
    if len(present) < 2:
        raise FileNotFoundError(
            f"{listing.file} names {len(frames)} images, of which {len(present)} exist "
            f"and 2 are needed; the first missing one is {missing[0] if missing else 'none'}"
        )
    if missing:
        warn_once(
            f"{len(missing)} of {len(frames)} images of {folder} are missing: {', '.join(missing)}"
        )
    _require_masks(listing.file, present)
    return present, missing


def _used(listing: Listing) -> list[PhotoFrame]:
    used = [frame for frame in listing.frames if frame.split != "unused"]
    if len(used) < len(listing.frames):
        warn_once(
            f"{len(listing.frames) - len(used)} of {len(listing.frames)} frames of {listing.file} "
            "are in none of its splits and are left out"
        )
    return used


def _require_masks(file: UPath, frames: Sequence[PhotoFrame]) -> None:
    masks = [frame.mask for frame in frames if frame.mask is not None]
    there = existing(masks)
    missing = [mask for mask in masks if mask not in there]
    if missing:
        raise FileNotFoundError(
            f"{file} names {len(masks)} masks, of which {len(missing)} do not exist, the first "
            f"being {missing[0]}: add them, or remove their 'mask_path'"
        )


def read_photos(
    path: str | Path | UPath,
    image_size: tuple[int, int],
    frames: Sequence[int] | None = None,
    format: Format = "auto",
) -> Views:
    """Views (1, V) of a photo folder, in the world of its poses; all frames unless some are named.

    Raises FileNotFoundError and ValueError as `PhotosSource`, IndexError for frames out of range.
    """
    folder = opened_path(path)
    listed = present_frames(folder, format)[0]
    scene = PhotoScene(folder_name(folder), listed, Development(image_size))
    chosen = list(range(len(scene))) if frames is None else list(frames)
    outside = [frame for frame in chosen if not 0 <= frame < len(scene)]
    if outside:
        raise IndexError(f"{folder} has frames 0 to {len(scene) - 1}, asked for {outside}")
    cameras, masks = scene.cameras[chosen], scene.masks(chosen)
    return Views(
        scene.images(chosen)[None],
        Cameras(cameras.c2w[None].float(), cameras.intrinsics[None].float(), cameras.size),
        None if masks is None else masks[None],
    )
