"""Choose photo size and number of Gaussians of `qgs scene` for its time, and say so beforehand."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

from qgs.machine import available_bytes
from qgs.reconstruction.scenes import Size
from qgs_photos.refine.options import Options
from qgs_photos.refine.scene_photos import SMALL, ScenePhotos, sized

TIMED = 2048
"""Number of Gaussians, placed at pixels of photos, in the step that is timed. A scene without
COLMAP's points starts with at least this many Gaussians."""
SIZES = range(96, 2161, 16)
"""Photo sizes to choose from: shorter side in pixels."""
# In a minute, 2,400 to 3,100 steps gave up to .9 dB more, at the larger size, than 3,100 to 4,700
# on smaller photos. 1,600 steps on 320 x 320 pixels gave less than 2,000 on 128 x 128.
LEAST_STEPS = 2500
"""Least number of steps. A larger photo size is chosen only if the time allows this many steps."""
STEPS_OF_PHOTO = 15
"""Least number of steps per photo. LEAST_STEPS applies if it gives more steps in total."""
# twice as many gained less than their time
DENSITY = 0.6
"""Number of Gaussians as a fraction of the number of pixels in a photo."""
MOST_GAUSSIANS = 262_144
# Of memory for each value of a photo, at all its sizes: half of it is kept free.
_BYTES = 16
# Exponents of the time of a step, measured on CPUs. Coarse levels save as much time as growing
# Gaussians take, so the mean step takes as long as the first at full size.
_OF_PIXELS = 0.38
_OF_GAUSSIANS = 0.54


@dataclass(frozen=True)
class Budget:
    """Time of the optimisation of `photos`, and what it allows.

    step: measured seconds of a step with TIMED Gaussians on a photo of size `timed` (H, W).
    options: a size or a number of Gaussians given in the options is kept.
    """

    step: float
    timed: Size
    photos: ScenePhotos
    options: Options

    def affordable(self, seconds: float) -> Size:
        """Return the largest photo size (H, W) that time and memory allow.

        seconds: time of the optimisation. If even the smallest size is too large, the smallest size
        is returned.
        """
        if self.options.size:
            return self.options.size
        available = available_bytes()
        best, *larger = (sized(self.photos.small, side) for side in SIZES)
        for size in larger:
            memory = 3 * math.prod(size) * len(self.photos.frames) * _BYTES
            # sizes ascend: the first that takes too long ends the search
            if self.needed(size) > seconds or memory > available:
                break
            best = size
        return best

    def count(self, size: Size) -> int:
        """Return the number of Gaussians for photos of size (H, W)."""
        return self.options.gaussians or min(round(DENSITY * math.prod(size)), MOST_GAUSSIANS)

    def mean_step(self, size: Size) -> float:
        """Return the seconds of a step on photos of size (H, W), a mean over the optimisation."""
        pixels = math.prod(size) / math.prod(self.timed)
        slower = pixels**_OF_PIXELS * (self.count(size) / TIMED) ** _OF_GAUSSIANS
        return self.step * slower

    def needed(self, size: Size) -> float:
        """Return the least seconds of an optimisation on photos of size (H, W)."""
        return max(LEAST_STEPS, STEPS_OF_PHOTO * len(self.photos.frames)) * self.mean_step(size)

    def described(self, size: Size) -> str:
        """Return words for photos of size (H, W) and their Gaussians."""
        height, width = size
        return f"photos of {height} x {width} pixels with {self.count(size):,} Gaussians"

    def sentences(self, size: Size, opened: float, seconds: float) -> Iterator[str]:
        """Yield what `seconds` of optimisation will do, and what more time would give.

        size: chosen size (H, W) of photos. opened: seconds until photos and poses were ready.
        """
        more = self.affordable(2 * seconds)
        steps = seconds / self.mean_step(size)
        twice = "twice as many steps" if more == size else self.described(more)
        yield (
            f"poses were ready after {opened:.0f} s; {seconds:.0f} s are for about {steps:,.0f} "
            f"steps on {self.described(size)}; twice the time would give {twice}"
        )
        enough = sized(self.photos.small, SMALL)
        lacking = self.needed(enough) - seconds
        # stored photos may be smaller, and are never enlarged
        if not self.options.size and size != enough and lacking > 0:
            minutes = math.ceil(lacking / 6) / 10
            yield f"these photos are small; {minutes} minutes more would give {min(enough)} pixels"
