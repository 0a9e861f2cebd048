"""What a camera makes of light: exposure, white balance, tone curve, vignette, noise, JPEG."""

import io

import numpy as np
from numba import njit
from PIL import Image
from qgs_rooms.textures import OPTIONS

from qgs_worlds import rows as r
from qgs_worlds.textures import scrambled

_SHOULDER = 0.6  # of full brightness, from where on highlights are compressed


@njit(**OPTIONS)
def develop(image, light, effects, frame):
    """Write image (H, W, 3) uint8 for light (H, W, 3), linear. effects: fields of `rows`."""
    height, width, _ = light.shape
    reach, seed = 1.0 / (height * height + width * width), int(effects[r.NOISE_SEED])
    for i in range(height):
        for j in range(width):
            y, x = 2 * i + 1 - height, 2 * j + 1 - width
            edge = 1.0 - effects[r.VIGNETTE] * (x * x + y * y) * reach
            h = scrambled(i * width + j, frame, seed)
            for c in range(3):
                value = max(light[i, j, c] * effects[r.GAINS + c] * edge, 0.0)
                value **= 1.0 / effects[r.GAMMA]
                if value > _SHOULDER:
                    over = (value - _SHOULDER) / (1 - _SHOULDER)
                    value = _SHOULDER + (1 - _SHOULDER) * over / (1 + over**2) ** 0.5
                # two uniform numbers for each colour: near enough to a normal one
                a, b = (h >> 10 * c) & 31, (h >> (10 * c + 5)) & 31
                value += effects[r.NOISE] * (a + b - 31) * (1 / 13.06)
                image[i, j, c] = int(255 * min(max(value, 0.0), 1.0) + 0.5)


def through_jpeg(image: np.ndarray, quality: int) -> np.ndarray:
    """The image (H, W, 3) uint8 as a JPEG file of that quality keeps it."""
    file = io.BytesIO()
    Image.fromarray(image).save(file, "JPEG", quality=quality)
    return np.asarray(Image.open(file))
