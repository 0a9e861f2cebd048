"""Gaussians from the cameras of a path, as a video file."""

from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import torch
from PIL import Image

from qgs.contracts import Renderer
from qgs.drawing.images import rgb_picture
from qgs.files import replacing
from qgs.types import Cameras, Gaussians

SUFFIXES = (".mp4", ".webp")
# Of x264; 0 loses nothing, 23 is its default.
_QUALITY = "18"


@torch.no_grad()
def pictures(
    gaussians: Gaussians, path: Cameras, renderer: Renderer, progress: Callable[[int], None]
) -> Iterator[np.ndarray]:
    """Yield the scene (1, G) from each camera (1, T) of a path, uint8 (H, W, 3)."""
    for frame in range(path.shape[1]):
        yield rgb_picture(renderer(gaussians, path[:, frame : frame + 1]).rgb[0, 0])
        progress(frame + 1)


def write_film(frames: Iterator[np.ndarray], file: Path, rate: int) -> None:
    """Write pictures of one size, `rate` a second, as H.264 in mp4, or as an endless WebP."""
    refuse_suffix(file)
    with replacing(file) as temporary:
        if file.suffix.lower() == ".webp":
            _write_webp(frames, temporary, rate)
        else:
            _write_mp4(frames, temporary, rate)


def refuse_suffix(file: Path) -> None:
    """Raise ValueError for a file of another kind."""
    if file.suffix.lower() not in SUFFIXES:
        raise ValueError(f"{file} is no name of a video: it must end with {' or '.join(SUFFIXES)}")


def _write_mp4(frames: Iterator[np.ndarray], path: Path, rate: int) -> None:
    # browsers show it before all is there
    options = {"movflags": "+faststart"}
    with av.open(str(path), "w", format="mp4", options=options) as container:
        stream = container.add_stream("libx264", rate=rate, options={"crf": _QUALITY})
        stream.pix_fmt = "yuv420p"
        stream.time_base = Fraction(1, rate)
        for number, picture in enumerate(frames):
            # its colours have half the resolution
            even = picture[: picture.shape[0] // 2 * 2, : picture.shape[1] // 2 * 2]
            if not number:
                stream.height, stream.width = even.shape[:2]
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(even), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def _write_webp(frames: Iterator[np.ndarray], path: Path, rate: int) -> None:
    first, *rest = map(Image.fromarray, frames)
    options = {"duration": round(1000 / rate), "loop": 0, "quality": 85, "method": 2}
    first.save(path, "WEBP", save_all=True, append_images=rest, **options)
