"""NeRF's synthetic scenes, rendered by Blender (Mildenhall et al., 2020)."""

from dataclasses import replace

from upath import UPath

from qgs.data.photos.nerfstudio import read_transforms
from qgs.data.photos.reader import Listing, PhotoFrame, PhotoReader

_SPLITS = {"train": "train", "val": "test", "test": "test"}


class Blender(PhotoReader):
    """NeRF's synthetic scenes: a transforms file for each split; the alpha channel is the mask."""

    listing = "transforms_train.json"

    @classmethod
    def recognises(cls, folder: UPath) -> bool:
        """See `PhotoReader`: any of the files is enough."""
        return any((folder / f"transforms_{part}.json").is_file() for part in _SPLITS)

    @classmethod
    def read(cls, folder: UPath, images: str | None) -> Listing:
        """See `PhotoReader`: training frames first, others held out. `images`: ValueError."""
        if images is not None:
            raise ValueError(
                f"`images` is {images!r}, but the transforms files of {folder} name a folder for "
                "each split: leave `images` out"
            )
        frames: list[PhotoFrame] = []
        for part, split in _SPLITS.items():
            file = folder / f"transforms_{part}.json"
            if file.is_file():
                # these scenes have no masks but their alpha channel
                frames += [
                    replace(frame, split=split, mask=frame.mask or frame.path)
                    for frame in read_transforms(file)
                ]
        return Listing(folder, frames)
