"""Pictures in bands of rows, which threads share."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import torch

_BAND = 64  # rows of an image that one thread casts at a time


def in_bands(cast: Callable[[int, int, int], None], frames: int, height: int) -> None:
    """Call `cast(frame, top, bottom)` for all rows of all frames, on torch's number of threads."""
    tops = range(0, height, _BAND)
    bands = [(frame, top, min(top + _BAND, height)) for frame in range(frames) for top in tops]
    if torch.get_num_threads() == 1:
        for band in bands:
            cast(*band)
        return
    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        list(pool.map(lambda band: cast(*band), bands))  # raises what a thread raised
