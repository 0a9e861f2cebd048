"""Effects of a camera: exposure, white balance, tone curve, vignette, noise and JPEG."""

import io
import math
from typing import NamedTuple

import numpy as np
from PIL import Image

from qgs.kernels import kernel
from qgs_worlds.caster.vectors import inner

# Share of full brightness above which highlights are compressed.
_SHOULDER = 0.6
# Step of the tone curve's table over the square root of light, which is finer for dark tones.
_STEP = 1 / 512
_ENTRIES = 2048


@inner
def _scrambled(i, j, seed):
    """Return 32 pseudo-random bits for pixel number i of image number j."""
    h = (i * 374761393 + j * 668265263 + seed * 974634777) & 0xFFFFFFFF
    h = ((h ^ (h >> 13)) * 1274126177) & 0xFFFFFFFF
    h = ((h ^ (h >> 15)) * 739982445) & 0xFFFFFFFF
    return h ^ (h >> 16)


@kernel
def _curve(gamma):
    """Return the tone curve as a table: entry i is the output for a light of (i * _STEP)^2."""
    table = np.empty(_ENTRIES)
    for i in range(_ENTRIES):
        value = (i * _STEP) ** (2.0 / gamma)
        if value > _SHOULDER:
            over = (value - _SHOULDER) / (1 - _SHOULDER)
            value = _SHOULDER + (1 - _SHOULDER) * over / math.sqrt(1 + over * over)
        table[i] = value
    return table


@kernel
def _develop(image, light, gains, gamma, vignette, grain, seed, frame):
    height, width, _ = light.shape
    reach = 1.0 / (height * height + width * width)
    curve = _curve(gamma)
    for i in range(height):
        for j in range(width):
            y = 2 * i + 1 - height
            x = 2 * j + 1 - width
            edge = 1.0 - vignette * (x * x + y * y) * reach
            # a hash instead of a generator, so that threads and frames need no order
            h = _scrambled(i * width + j, frame, seed)
            for c in range(3):
                value = math.sqrt(max(light[i, j, c] * gains[c] * edge, 0.0))
                value = 255 * curve[min(int(value * (1 / _STEP) + 0.5), _ENTRIES - 1)]
                # two uniform numbers for each colour are close enough to a normal one
                value += grain * (((h >> 10 * c) & 31) + ((h >> (10 * c + 5)) & 31) - 31)
                image[i, j, c] = int(min(max(value, 0.0), 255.0) + 0.5)


class Effects(NamedTuple):
    """Camera effects that turn linear light into a photo.

    gains: factors (3,) of the light in R, G and B. gamma: the tone curve raises light to the
    power 1 / gamma. vignette: share of light lost at the corners. noise: standard deviation as a
    share of full brightness. seed: seed of the noise. quality: JPEG quality; 0 for no compression.
    """

    gains: np.ndarray
    gamma: float
    vignette: float = 0.0
    noise: float = 0.0
    seed: int = 0
    quality: int = 0

    def photo(self, light: np.ndarray, frame: int) -> np.ndarray:
        """Turn linear light (H, W, 3) into a photo (H, W, 3) uint8.

        frame: index of the camera, which changes the noise from photo to photo.
        """
        image = np.empty(light.shape, np.uint8)
        # the sum of two numbers of 0 to 31 has a standard deviation of 13.06
        grain = 255 / 13.06 * self.noise
        _develop(image, light, self.gains, self.gamma, self.vignette, grain, self.seed, frame)
        if not self.quality:
            return image
        # compress and decompress as a JPEG file of that quality
        file = io.BytesIO()
        Image.fromarray(image).save(file, "JPEG", quality=self.quality)
        return np.asarray(Image.open(file))
