"""Read NeRF's synthetic scenes, which were rendered by Blender (Mildenhall et al., 2020)."""

from dataclasses import replace

from upath import UPath

from qgs.data.photos.nerfstudio import read_transforms
from qgs.data.photos.reader import Listing, PhotoFrame, PhotoReader

_SPLITS = {"train": "train", "val": "test", "test": "test"}


class Blender(PhotoReader):
    """Reader of NeRF's synthetic scenes.

    Each split has a transforms file. The alpha channel of a photo is its mask.
    """

    listing = "transforms_train.json"

    @classmethod
    def recognises(cls, folder: UPath) -> bool:
        """Return whether `folder` holds the transforms file of at least one split."""
        return any((folder / f"transforms_{part}.json").is_file() for part in _SPLITS)

    @classmethod
    def read(cls, folder: UPath, images: str | None) -> Listing:
        """Read the frames of all splits: first train, then val and test, which are held out.

        Raises ValueError if `images` is given, since transforms files name the folders of photos.
        """
        if images is not None:
            raise ValueError(
                f"`images` is {images!r}, but the transforms files of {folder} name a folder for "
                "each split: leave `images` out"
            )
        frames = list[PhotoFrame]()
        for part, split in _SPLITS.items():
            file = folder / f"transforms_{part}.json"
            if file.is_file():
                # these scenes have no masks but their alpha channel
                frames += [
                    replace(frame, split=split, mask=frame.mask or frame.path)
                    for frame in read_transforms(file)
                ]
        return Listing(folder, frames)
