"""The photos of `qgs scene`: which are held out, and how large they may be in a given time."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

from qgs.contracts import Frames, Scene
from qgs.data.frames import held_out_frames
from qgs.data.recognition import open_for
from qgs.machine import available_bytes
from qgs.reconstruction.scenes import Size, installed_sources, named_scene
from qgs_photos.refine.options import NONE, Options

SIZES = range(96, 2161, 16)
"""Shorter sides that are considered, pixels."""
# 1,600 steps on 320 x 320 pixels gave less, at any size, than 2,000 on 128 x 128 did in a fifth of
# the time.
LEAST_STEPS = 4000
"""Steps that a refinement takes at least; then photos may be larger."""
STEPS_OF_PHOTO = 25
"""Steps of each photo, where these are more."""
# twice as many gained less than their time
DENSITY = 0.6
"""Gaussians over pixels of a photo."""
MOST_GAUSSIANS = 262_144
# Of memory for each value of a photo, at all its sizes: half of it is kept free.
_BYTES = 16
# Exponents of the time of a step, measured on CPUs.
_OF_PIXELS, _OF_GAUSSIANS = 0.77, 0.3
# Time of a step in the mean over coarse levels, over that of a start at full size.
_COARSE = 0.9
# Shorter side with which a step is timed.
_SMALL = 128


class ScenePhotos:
    """The photos of `qgs scene` at any size.

    small: the scene at a small size. held_out: frames that are judged, and frames: those that are
    optimised on.
    """

    def __init__(self, path: str, options: Options) -> None:
        self.path = path
        self.name = options.scene
        self._sources = installed_sources()
        found = self.at(None)
        self.small = self.at(sized(found, _SMALL))
        self.held_out = judged_frames(found, options.holdout)
        self.frames = tuple(frame for frame in range(len(found)) if frame not in self.held_out)
        # a model's inputs are chosen among the others
        self.small.held_out = self.held_out

    def at(self, size: Size | None) -> Scene:
        """Return the scene with photos of this size (H, W)."""
        source, _ = open_for(self.path, size, None, self._sources)
        return named_scene(source, self.path, self.name)


def judged_frames(scene: Scene, holdout: str) -> Frames:
    """Return the frames that are judged and never optimised on.

    holdout: NONE, or n as of `held_out_frames`; a split of the photos' own goes first. Raises
    ValueError for another text.
    """
    if holdout == NONE:
        return ()
    if not holdout.isdecimal() or int(holdout) < 2:
        raise ValueError(f"--holdout must be none or every how many, such as 8; got {holdout!r}")
    return tuple(scene.held_out) or held_out_frames(len(scene), int(holdout))


def sized(scene: Scene, side: int) -> Size:
    """Return (H, W) of whole photos with this shorter side, never larger than stored."""
    stored = scene.stored_size(0) or scene.cameras.size
    # enlarged photos show nothing more and take longer
    factor = min(side / min(stored), 1.0)
    height, width = (max(round(factor * length), 1) for length in stored)
    return height, width


@dataclass(frozen=True)
class StepTime:
    """Seconds of a step on a photo of `size` (H, W) with `gaussians` of them."""

    seconds: float
    size: Size
    gaussians: int

    def at(self, size: Size, gaussians: int) -> float:
        """Return the seconds of a step with others, in the mean over an optimisation."""
        pixels = (math.prod(size) / math.prod(self.size)) ** _OF_PIXELS
        return _COARSE * self.seconds * pixels * (gaussians / self.gaussians) ** _OF_GAUSSIANS


def affordable(
    time: StepTime, photos: ScenePhotos, seconds: float, options: Options
) -> tuple[Size, int]:
    """Return photo size and number of Gaussians for which `seconds` and the memory are enough.

    What the options set stays. The smallest size is taken where nothing is enough.
    """
    steps = max(LEAST_STEPS, STEPS_OF_PHOTO * len(photos.frames))
    available = available_bytes()
    best: tuple[Size, int] | None = None
    for size in _sizes(photos.small, options.size):
        count = options.gaussians or min(round(DENSITY * math.prod(size)), MOST_GAUSSIANS)
        memory = 3 * math.prod(size) * len(photos.frames) * _BYTES
        # sizes ascend: the first that takes too long ends the search
        if best is not None and (steps * time.at(size, count) > seconds or memory > available):
            break
        best = size, count
    assert best is not None
    return best


def _sizes(scene: Scene, wanted: Size | None) -> Iterator[Size]:
    """Yield the wanted size, else those of SIZES up to the stored one, ascending."""
    own = dict.fromkeys(sized(scene, side) for side in SIZES)
    yield from own if wanted is None else (wanted,)
