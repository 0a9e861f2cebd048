"""Frames of a video: even intervals, of each the sharpest."""

from collections.abc import Callable, Iterator
from contextlib import suppress
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.error import FFmpegError
from PIL import Image

from qgs.wording import counted
from qgs_poses.photos import LEAST, PosesError, laplacian_variance

FEWEST, MOST, PER_SECOND = 40, 120, 2.0
"""How many frames are taken of a video."""
_JUDGED = 8  # frames of an interval that are compared
_SIDE = 640


def taken(seconds: float) -> int:
    """How many frames are taken of a video."""
    return int(min(max(seconds * PER_SECOND, FEWEST), MOST))


def extract(
    video: Path,
    folder: Path,
    count: int | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[str]:
    """Write the sharpest frame of each of `count` even intervals of time as JPEG, upright.

    Returns remarks. What cannot be decoded is left out. Raises PosesError for no video, and for
    fewer than LEAST frames.
    """
    times, broken = _times(video)
    if len(times) < LEAST:
        raise PosesError(
            f"{video} has {counted(len(times), 'frame')} that can be read, and poses need {LEAST} "
            "at least: take a longer video, or copy it again"
        )
    start, end = times[0], times[-1]
    wanted = min(count or taken(float(end - start)), len(times))
    # the last frame is shown as long as the others in the mean
    length = (end - start) * Fraction(len(times), len(times) - 1) / wanted or Fraction(1)
    every = max(len(times) // (wanted * _JUDGED), 1)
    written, faults, last = 0, 0, start
    place, best, sharpest = 0, None, -1.0
    for number, (time, frame) in enumerate(_decoded(video)):
        if frame is None:
            faults += 1
            continue
        here = min(max(int((time - start) / length), 0), wanted - 1)
        if here != place and best is not None:
            _write(best, folder / f"{place:05d}.jpg")
            written, best, sharpest = written + 1, None, -1.0
            progress(here, wanted)
        place, last = here, max(last, time)
        if best is not None and number % every:
            continue
        score = _sharpness(frame)
        if score > sharpest:
            best, sharpest = frame, score
    if best is not None:
        _write(best, folder / f"{place:05d}.jpg")
        written += 1
    if written < LEAST:
        raise PosesError(
            f"{video} has {counted(written, 'frame')} that can be decoded, and poses need "
            f"{LEAST} at least: convert it to H.264, or copy it again"
        )
    remarks = []
    if broken or faults:
        remarks.append(
            f"{video} is damaged: {written} of {wanted} intervals have a frame, the last one at "
            f"{float(last - start):.1f} s"
        )
    return remarks


def _opened(video: Path) -> Any:
    """The container and its first video stream. Raises PosesError where there is none."""
    try:
        container = av.open(str(video))
    except (FFmpegError, ValueError) as error:
        raise PosesError(
            f"{video} cannot be read as a video ({error}): convert it to H.264 in mp4, or copy it "
            "again"
        ) from error
    # a cover picture of a song is a video of one frame
    if not container.streams.video:
        container.close()
        raise PosesError(f"{video} has no pictures: give a video")
    return container


def _times(video: Path) -> tuple[list[Fraction], bool]:
    """When each frame is shown, ascending, from the packets alone; whether the file is cut off."""
    times, broken = list[Fraction](), False
    with _opened(video) as container:
        stream = container.streams.video[0]
        try:
            for packet in container.demux(stream):
                if packet.pts is not None:
                    times.append(packet.pts * stream.time_base)
                broken |= packet.is_corrupt
        except FFmpegError:
            broken = True
    return sorted(times), broken


def _decoded(video: Path) -> Iterator[tuple[Fraction, Any]]:
    """Time and frame; (0, None) for a packet that cannot be decoded."""
    with _opened(video) as container:
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        with suppress(FFmpegError):  # what follows a hole in the file is lost
            for packet in container.demux(stream):
                try:
                    frames = packet.decode()
                except FFmpegError:
                    yield Fraction(0), None
                    continue
                for frame in frames:
                    if frame.pts is not None:
                        yield frame.pts * stream.time_base, frame


def _sharpness(frame: Any) -> float:
    scale = _SIDE / max(frame.width, frame.height)
    width, height = (max(round(side * scale) // 2 * 2, 4) for side in (frame.width, frame.height))
    grey = frame.reformat(width=width, height=height, format="gray").to_ndarray()
    return laplacian_variance(grey.astype(np.float32))


def _write(frame: Any, path: Path) -> None:
    """As JPEG, turned as the video says."""
    image = Image.fromarray(frame.to_ndarray(format="rgb24"))
    turns = round(frame.rotation / 90) % 4  # counterclockwise, in degrees
    if turns:
        kinds = (Image.Transpose.ROTATE_90, Image.Transpose.ROTATE_180, Image.Transpose.ROTATE_270)
        image = image.transpose(kinds[turns - 1])
    image.save(path, quality=95, subsampling=0)
