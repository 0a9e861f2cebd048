"""What a camera makes of light: exposure, white balance, tone curve, vignette, noise, JPEG."""

import io
import math

import numpy as np
from numba import njit
from PIL import Image

from qgs_worlds import rows as r
from qgs_worlds.rooms.textures import INNER, OPTIONS

_SHOULDER = 0.6  # of full brightness, from where on highlights are compressed
_STEP, _ENTRIES = 1 / 512, 2048  # of the table of the tone curve


@njit(**INNER)
def _scrambled(i, j, seed):
    """32 random bits for each pixel i of frame j."""
    h = (i * 374761393 + j * 668265263 + seed * 974634777) & 0xFFFFFFFF
    h = ((h ^ (h >> 13)) * 1274126177) & 0xFFFFFFFF
    h = ((h ^ (h >> 15)) * 739982445) & 0xFFFFFFFF
    return h ^ (h >> 16)


@njit(**INNER)
def _curve(gamma):
    """What becomes of the square root of light, from 0 on in steps of `_STEP`."""
    table = np.empty(_ENTRIES)
    for i in range(_ENTRIES):
        value = (i * _STEP) ** (2.0 / gamma)
        if value > _SHOULDER:
            over = (value - _SHOULDER) / (1 - _SHOULDER)
            value = _SHOULDER + (1 - _SHOULDER) * over / math.sqrt(1 + over * over)
        table[i] = value
    return table


@njit(**OPTIONS)
def develop(image, light, effects, frame):
    """Write image (H, W, 3) uint8 for light (H, W, 3), linear. effects: fields of `rows`."""
    height, width, _ = light.shape
    reach, seed = 1.0 / (height * height + width * width), int(effects[r.NOISE_SEED])
    curve, grain = _curve(effects[r.GAMMA]), 255 / 13.06 * effects[r.NOISE]
    for i in range(height):
        for j in range(width):
            y, x = 2 * i + 1 - height, 2 * j + 1 - width
            edge = 1.0 - effects[r.VIGNETTE] * (x * x + y * y) * reach
            h = _scrambled(i * width + j, frame, seed)
            for c in range(3):
                value = math.sqrt(max(light[i, j, c] * effects[r.GAINS + c] * edge, 0.0))
                value = 255 * curve[min(int(value * (1 / _STEP) + 0.5), _ENTRIES - 1)]
                # two uniform numbers for each colour: near enough to a normal one
                value += grain * (((h >> 10 * c) & 31) + ((h >> (10 * c + 5)) & 31) - 31)
                image[i, j, c] = int(min(max(value, 0.0), 255.0) + 0.5)


def through_jpeg(image: np.ndarray, quality: int) -> np.ndarray:
    """The image (H, W, 3) uint8 as a JPEG file of that quality keeps it."""
    file = io.BytesIO()
    Image.fromarray(image).save(file, "JPEG", quality=quality)
    return np.asarray(Image.open(file))
