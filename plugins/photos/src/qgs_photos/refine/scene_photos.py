"""Open the photos of `qgs scene`: choose held-out photos, and a photo size for a given time."""

import math

from qgs.contracts import Frames, Scene
from qgs.data.view_samplers import held_out_frames
from qgs.machine import available_bytes
from qgs.reconstruction.scenes import Size, photo_scene
from qgs_photos.refine.options import NONE, Options

TIMED = 2048
"""Number of Gaussians, placed at pixels of photos, in the step that is timed. A scene without
COLMAP's points starts with at least this many Gaussians."""
SIZES = range(96, 2161, 16)
"""Photo sizes to choose from: shorter side in pixels."""
# 1,600 steps on 320 x 320 pixels gave less, at any size, than 2,000 on 128 x 128 did in a fifth of
# the time.
LEAST_STEPS = 4000
"""Least number of steps. A larger photo size is chosen only if the time allows this many steps."""
STEPS_OF_PHOTO = 25
"""Least number of steps per photo. LEAST_STEPS applies if it gives more steps in total."""
# twice as many gained less than their time
DENSITY = 0.6
"""Number of Gaussians as a fraction of the number of pixels in a photo."""
MOST_GAUSSIANS = 262_144
# Of memory for each value of a photo, at all its sizes: half of it is kept free.
_BYTES = 16
# Exponents of the time of a step, measured on CPUs.
_OF_PIXELS = 0.77
_OF_GAUSSIANS = 0.3
# Time of a step in the mean over coarse levels, over that of a start at full size.
_COARSE = 0.9
# Shorter side with which a step is timed.
_SMALL = 128


class ScenePhotos:
    """The photos of `qgs scene`, at any size.

    path: folder, URL or video. small: the scene with small photos. held_out: indices of photos that
    are held out for scores. frames: indices of the other photos, for the optimisation.
    """

    def __init__(self, path: str, options: Options) -> None:
        self.path = path
        self.name = options.scene
        found = self.at(None)
        self.small = self.at(sized(found, _SMALL))
        self.held_out = judged_frames(found, options.holdout)
        self.frames = tuple(frame for frame in range(len(found)) if frame not in self.held_out)
        # a model's inputs are chosen among the others
        self.small.held_out = self.held_out

    def at(self, size: Size | None) -> Scene:
        """Return the scene with photos of `size` (H, W); None takes the stored size."""
        return photo_scene(self.path, size, self.name)


def judged_frames(scene: Scene, holdout: str) -> Frames:
    """Return the indices of the held-out photos, which are scored and never optimised on.

    holdout: NONE holds out no photo. A number N of at least 2 holds out the photos that the data
    set lists as held out, or every Nth if it lists none. Raises ValueError for another text.
    """
    if holdout == NONE:
        return ()
    if not holdout.isdecimal() or int(holdout) < 2:
        raise ValueError(
            "--holdout must be none, or a number N of at least 2 to hold out every Nth photo; got "
            f"{holdout!r}"
        )
    return tuple(scene.held_out) or held_out_frames(len(scene), int(holdout))


def sized(scene: Scene, side: int) -> Size:
    """Return (H, W) of uncropped photos whose shorter side has `side` pixels.

    The result is never larger than the stored photos.
    """
    stored = scene.stored_size(0) or scene.cameras.size
    # enlarged photos show nothing more and take longer
    factor = min(side / min(stored), 1.0)
    height, width = (max(round(factor * length), 1) for length in stored)
    return height, width


def affordable(
    step: float, timed: Size, photos: ScenePhotos, seconds: float, options: Options
) -> tuple[Size, int]:
    """Return the largest photo size (H, W) that time and memory allow, and a number of Gaussians.

    step: measured seconds of a step with TIMED Gaussians on a photo of size `timed` (H, W).
    seconds: time of the optimisation. options: a size or a number of Gaussians given in the options
    is kept. If even the smallest size is too large, the smallest size is returned.
    """
    steps = max(LEAST_STEPS, STEPS_OF_PHOTO * len(photos.frames))
    available = available_bytes()
    best: tuple[Size, int] | None = None
    for size in [options.size] if options.size else [sized(photos.small, side) for side in SIZES]:
        pixels = math.prod(size)
        count = options.gaussians or min(round(DENSITY * pixels), MOST_GAUSSIANS)
        slower = (pixels / math.prod(timed)) ** _OF_PIXELS * (count / TIMED) ** _OF_GAUSSIANS
        memory = 3 * pixels * len(photos.frames) * _BYTES
        # sizes ascend: the first that takes too long ends the search
        too_slow = steps * _COARSE * step * slower > seconds
        if best is not None and (too_slow or memory > available):
            break
        best = size, count
    assert best is not None
    return best
