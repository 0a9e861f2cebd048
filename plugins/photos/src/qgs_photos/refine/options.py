"""Options of `qgs scene`, as the user gives them, or with all values that the command chooses."""

import shlex
from dataclasses import dataclass
from pathlib import Path

from qgs.reconstruction.scenes import Size
from qgs_photos.refine.metric import Distance
from qgs_photos.refine.refining import NO_EXTRAS, Extras

NONE = "none"
"""Value "none": for --model, start from the photos alone; for --holdout, hold no photo out."""


@dataclass(frozen=True)
class Options:
    """Options of `qgs scene`; None lets the command choose.

    model: name of the model that makes the first Gaussians, or NONE. earlier: folder of a scene
    with the first Gaussians, in place of a model. frames: input photos of the model, separated by
    commas. scale: factor on camera positions for the model. size: (H, W) of the photos in pixels.
    gaussians: number of Gaussians. seconds: time of the optimisation alone.
    holdout: N to hold out every Nth photo, or NONE. scene: name of the scene if there are several.
    extras: further quantities to optimise. masks: treat pixels outside masks as background.
    scale_by: a measured distance, so that files are in metres.
    """

    model: str | None = None
    earlier: Path | None = None
    frames: str | None = None
    scale: float | None = None
    size: Size | None = None
    gaussians: int | None = None
    seconds: float | None = None
    holdout: str = "8"
    scene: str | None = None
    device: str = "cpu"
    extras: Extras = NO_EXTRAS
    masks: bool = False
    scale_by: Distance | None = None

    def command(self, photos: str, out: str) -> str:
        """Return a command line that repeats `qgs scene`. `size` and `seconds` must be set."""
        assert self.size
        assert self.seconds
        height, width = self.size
        values = {
            "--out": out,
            "--scene": self.scene,
            "--model": self.model,
            "--from": self.earlier,
            "--frames": self.frames,
            "--scale": self.scale,
            "--size": f"{height}x{width}",
            "--gaussians": self.gaussians,
            "--seconds": f"{self.seconds:.4g}",
            "--holdout": self.holdout,
            "--degree": self.extras.degree,
        }
        words = ["qgs", "scene", photos]
        for name, value in values.items():
            words += [] if value is None else [name, str(value)]
        for what in self.extras.adjust or ():
            words += ["--adjust", what]
        words += ["--masks"] if self.masks else []
        words += ["--scale-by", *map(str, self.scale_by)] if self.scale_by else []
        return shlex.join(words)
