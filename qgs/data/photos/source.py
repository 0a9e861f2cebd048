"""`qgs/photos`: a folder of photos with their cameras, or a folder of such folders."""

from functools import partial
from typing import ClassVar

from upath import UPath

from qgs.contracts import SceneSourceConfig
from qgs.data.photos import formats_of
from qgs.data.photos.scene import PhotoScene, PhotosConfig, image_cache
from qgs.data.scenes import LazyScenes, LazySource
from qgs.paths import listing, opened_path
from qgs.wording import listed, warn_once


class PhotosSource(LazySource):
    """Photos of one scene or of many; both splits are the same scenes, with held-out frames.

    Only where the folder has scenes in `train` and `test`, the splits are those. A single scene is
    opened at once; of many, each is when it is asked for. Raises as `present_frames`.
    """

    name = "photos"
    Config = PhotosConfig
    tells_times: ClassVar[bool] = True
    not_in_protocol: ClassVar[frozenset[str]] = frozenset({"path", "outside"})
    split_options: ClassVar[frozenset[str]] = frozenset({"holdout", "max_frames"})

    def __init__(self, config: PhotosConfig) -> None:
        super().__init__(config)
        root = opened_path(config.path)

        def scenes(folders: dict[str, UPath]) -> LazyScenes:
            return LazyScenes(folders, partial(PhotoScene, config=config, cache=image_cache()))

        folders = {folder_name(root): root}
        if root.is_dir() and not formats_of(root):
            train = _folders(root / "train", config)
            test = _folders(root / "test", config)
            if train and test:
                self.splits = {"train": scenes(train), "test": scenes(test)}
                return
            folders = _folders(root, config) or folders
        both = scenes(folders)
        self.splits = {"train": both, "test": both}
        if len(both) == 1:
            # Raises at once what is wrong.
            _ = both[0].cameras

    @classmethod
    def recognises(cls, path: UPath) -> bool:
        """Return whether the folder lists cameras.

        Any other folder, of scenes too, is opened as photos for want of another source.
        """
        return bool(formats_of(path))

    @classmethod
    def trains_on(cls, root: UPath, path: UPath) -> bool:
        """See `SceneSource`: also a scene in a folder of scenes, or in its train."""
        inside = path in (root / path.name, root / "train" / path.name)
        return path == root or (inside and bool(formats_of(path)))

    @classmethod
    def config_for(
        cls, path: str, image_size: tuple[int, int], trained: SceneSourceConfig | None
    ) -> SceneSourceConfig:
        """See `SceneSource`; no frame is held out."""
        config = super().config_for(path, image_size, trained)
        return config.model_copy(update={"holdout": 0})


def _folders(root: UPath, config: PhotosConfig) -> dict[str, UPath]:
    """Return the folders in `root` that hold a scene in the wanted format, by name."""
    wanted: dict[str, UPath] = {}
    others: list[str] = []
    for folder in sorted(filter(UPath.is_dir, listing(root)), key=lambda item: item.name):
        held = formats_of(folder)
        if held and config.format in ("auto", *held):
            wanted[folder.name] = folder
        else:
            others.append(folder.name)
    if wanted and others:
        warn_once(
            f"{len(others)} of {len(wanted) + len(others)} folders in {root} hold no photos with "
            f"cameras and are left out: {listed(others)}"
        )
    return wanted


def folder_name(folder: UPath) -> str:
    """Return the name of the scene in `folder`."""
    return folder.resolve().name or "photos"
