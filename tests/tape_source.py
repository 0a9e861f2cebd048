"""A plugin with a data source of its own, `tapes/tape`, as a stranger would write it."""

from pathlib import Path

import numpy as np
import torch
from photo_formats import noise
from walk import along_x, pinhole

from qgs.contracts import Plugin, Scene, SceneSource


class Tape(Scene):
    """A file of images (F, H, W, 3) uint8 and poses (F, 4, 4); one in three is held out."""

    def __init__(self, file):
        with np.load(file) as arrays:
            self._images = arrays["images"]
            self._c2w = arrays["c2w"]
        self.name = file.stem
        self.held_out = tuple(range(1, len(self._images), 3))

    @property
    def cameras(self):
        return pinhole(torch.from_numpy(self._c2w), size=self._images.shape[1:3])

    def images(self, frames):
        return torch.from_numpy(self._images[list(frames)]).permute(0, 3, 1, 2).float() / 255


class TapeSource(SceneSource):
    """A folder of tapes, all of them for training."""

    name = "tape"

    class Config(SceneSource.Config):
        path: str
        """The folder."""

    @classmethod
    def recognises(cls, path):
        return path.is_dir() and any(item.suffix == ".tape" for item in path.iterdir())

    def scenes(self, split):
        return [Tape(file) for file in sorted(Path(self.config.path).glob("*.tape"))]


plugin = Plugin("tapes", 1, (TapeSource,))
INSTALLED = ("qgs-tapes", "tapes", "from tape_source import plugin")
"""For the fixture `install`."""


def write_tape(file, step=0.1):
    """Noise, seen by cameras a step apart."""
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("wb") as opened:
        np.savez(opened, images=noise(6, 16, 16, 3), c2w=along_x(step * np.arange(6)))
