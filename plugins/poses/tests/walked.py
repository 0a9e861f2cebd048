"""What tests of poses share."""

from pathlib import Path

import av
import numpy as np
from rich.console import Console

SCALE, PHOTOS = 3, 8
"""Size of the photos over that of `textured_room`, and how many there are."""


def quiet() -> Console:
    return Console(quiet=True)


def write_video(path: Path, images: list[np.ndarray], rate: int = 10, **options: str) -> Path:
    """An H.264 video of images of one size."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=rate, options={"crf": "15"} | options)
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        for image in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image)))
        container.mux(stream.encode())
    return path
