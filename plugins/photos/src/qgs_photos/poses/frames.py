"""Extract the sharpest frame of each interval of a video; intervals are shorter in fast motion."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any
from warnings import catch_warnings

import av
import numpy as np
from av.error import FFmpegError
from av.video.reformatter import ColorPrimaries, ColorTrc, VideoReformatter
from PIL import Image
from scipy.ndimage import laplace

from qgs.wording import counted
from qgs_photos.poses.photos import LEAST, PosesError, Show

# 120 at even steps of time are too few where the camera turns fast: of a walk through an office as
# a video, 42 of 120 frames got poses, and 143 of the 143 that follow the motion.
FEWEST, MOST, PER_SECOND = 40, 240, 2.0
"""Least and largest number of frames to take from a video, and least number for each second."""
STEP = 0.06
"""Motion after which the next frame is taken, as a fraction of the picture's sides."""
# Frames of an interval that are compared.
_JUDGED = 8
# Most seconds from frame to frame of a whole video; phones vary the rate by far less.
_PAUSE = 1.0
# Longer side in pixels at which sharpness is measured.
_SIDE = 640
# Height and width of the pictures that motion is measured by.
_THUMB = (48, 64)
# Transfer functions of HLG and PQ.
_HDR = (ColorTrc.ARIB_STD_B67, ColorTrc.SMPTE2084)
# Keeps its table of colours, which takes a second, from frame to frame.
_REFORMATTER = VideoReformatter()
_WINDOW = np.outer(np.hanning(_THUMB[0]), np.hanning(_THUMB[1]))


def extract(
    video: Path,
    folder: Path,
    count: int | None = None,
    progress: Show = lambda stage, done, total: None,
) -> list[str]:
    """Write the sharpest frame of each interval of a video into `folder`.

    Files are upright JPEGs, numbered from 0. Frames that cannot be decoded are left out. Returns a
    remark on a video that is damaged or lacks frames.

    count: number of intervals, all of the same duration. None makes intervals shorter in fast
    motion, and keeps at most MOST frames. progress: called with the stage, the seconds done, and
    the video's length. Raises PosesError if fewer than LEAST frames can be read.
    """
    times, aspect, damaged, end = _times(video)
    if len(times) < LEAST:
        raise PosesError(
            f"{video} has {counted(len(times), 'frame')} that can be read, but poses need at least "
            f"{LEAST}: take a longer video, or copy it again"
        )
    start = times[0]
    # the last frame is shown as long as the others in the mean
    length = (times[-1] - start) * len(times) / (len(times) - 1) or 1.0
    # more in a short video, so that there are FEWEST
    rate = count / length if count else max(PER_SECOND, FEWEST / length)
    every = max(int(len(times) / (length * rate) / _JUDGED), 1)
    scores = dict[Path, float]()
    best: tuple[Any, Path] | None = None
    shown = list[float]()
    placed = _placed(_decoded(video), start, rate, count)
    for number, (frame, place) in enumerate(placed):
        if frame is None:
            damaged = True
            continue
        shown.append(frame.time)
        progress("seconds of the video", int(frame.time - start), int(length))
        path = folder / f"{place:05d}.jpg"
        if path in scores and number % every:
            continue
        # a frame is written once its interval is over: large ones take long
        if best and path not in scores:
            _write(*best, aspect)
        score = _sharpness(frame)
        if score > scores.get(path, -1.0):
            scores[path] = score
            best = (frame, path)
    if best:
        _write(*best, aspect)
    if len(scores) < LEAST:
        raise PosesError(
            f"{video} has {counted(len(scores), 'frame')} that can be decoded, but poses need at "
            f"least {LEAST}: convert it to H.264, or copy it again"
        )
    if count is None:
        for path in scores.keys() - {*thinned(scores, MOST)}:
            path.unlink()
    return _remarks(video, shown, end, damaged)


def _remarks(video: Path, times: Sequence[float], end: float, damaged: bool) -> list[str]:
    """Return a remark on a video that is `damaged` or has no frames for more than _PAUSE, or none.

    times: of the decoded frames, in seconds. end: time at which the video ends.
    """
    steps = np.diff([*sorted(times), end])
    # at less than a frame a second no step is a pause
    lost = steps[steps > max(_PAUSE, 3 * np.median(steps))].sum()
    if not damaged and not lost:
        return []
    whole = end - min(times)
    seconds = f"{whole - lost:.1f} of {whole:.1f} s"
    return [f"{video} has frames for {seconds}: if it is damaged, copy it again"]


def thinned(scores: Mapping[Path, float], most: int) -> list[Path]:
    """Return at most `most` frames, evenly spread: the sharpest of each group of neighbours.

    scores: sharpness of each frame, by the frame's file.
    """
    best = dict[int, Path]()
    for number, path in enumerate(sorted(scores)):
        part = number * most // len(scores)
        # of equal ones the first
        best[part] = max(best.get(part, path), path, key=scores.__getitem__)
    return list(best.values())


def _placed(
    frames: Iterator[Any], start: float, rate: float, count: int | None
) -> Iterator[tuple[Any, int]]:
    """Yield each frame, or None, with the index of the interval that holds it.

    Frames must come in the order of time. One frame is taken from each interval. start: first time
    in seconds. rate: intervals per second. count: number of intervals, all of the same duration.
    With None, an interval ends when the picture has moved by the fraction STEP of its sides, or at
    the latest after 1 / `rate` seconds.
    """
    place = 0
    opened = start
    moved = 0.0
    before: np.ndarray | None = None
    for frame in frames:
        # an interval ends with the frame that is due, in spite of rounding
        if frame and count:
            due = int((frame.time - start) * rate + 1e-6)
            place = min(max(due, 0), count - 1)
        elif frame:
            after = _grey(frame, _THUMB)
            if before is not None:
                moved += shift(before, after)
            before = after
            if max((frame.time - opened) * rate + 1e-6, moved / STEP) >= 1:
                place += 1
                opened = frame.time
                moved = 0.0
        yield frame, place


def shift(before: np.ndarray, after: np.ndarray) -> float:
    """Return how far a picture moved, as a fraction of its sides, by phase correlation.

    before, after: small grey pictures of size _THUMB.
    """
    # imported for videos alone: photos need no motion
    from skimage.registration import phase_cross_correlation

    one, other = ((x - x.mean()) * _WINDOW for x in (before, after))
    # it warns of pictures of one colour
    with catch_warnings(action="ignore"):
        moved, *_ = phase_cross_correlation(one, other)
    return float(np.linalg.norm(moved / _THUMB))


def _opened(video: Path) -> Any:
    """Open a video file. Raises PosesError if it cannot be read or has no video stream."""
    try:
        container = av.open(str(video))
    except (FFmpegError, ValueError) as error:
        raise PosesError(
            f"{video} cannot be read as a video ({error}): convert it to H.264 in mp4, or copy it "
            "again"
        ) from error
    if not container.streams.video:
        container.close()
        raise PosesError(f"{video} has no video stream: give a file that holds a video")
    return container


def _times(video: Path) -> tuple[list[float], float, bool, float]:
    """Return frame times of a video in seconds, its pixel aspect, if it is damaged, and its end.

    Times ascend. The pixel aspect is a pixel's width over its height. The end is the time that the
    file lists, but not before the last frame. Packets are not decoded.
    """
    times = list[float]()
    broken = False
    with _opened(video) as container:
        stream = container.streams.video[0]
        aspect = float(stream.sample_aspect_ratio or 1)
        # not all kinds of files have the length of the frames, and sound may be longer
        length = container.duration if len(container.streams) == 1 else 0
        seconds = (stream.duration or 0) * stream.time_base or (length or 0) / 1e6
        try:
            for packet in container.demux(stream):
                if packet.pts is not None:
                    times.append(float(packet.pts * stream.time_base))
                broken |= packet.is_corrupt
        except FFmpegError:
            broken = True
    return sorted(times), aspect, broken, float(max([seconds, *times]))


def _decoded(video: Path) -> Iterator[Any]:
    """Yield each frame of a video that has a time, and None for an undecodable packet."""
    with _opened(video) as container:
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        # what follows a hole in the file is lost
        with suppress(FFmpegError):
            for packet in container.demux(stream):
                try:
                    frames = packet.decode()
                except FFmpegError:
                    yield None
                    continue
                yield from (frame for frame in frames if frame.time is not None)


def _sharpness(frame: Any) -> float:
    scale = _SIDE / max(frame.width, frame.height)
    # FFmpeg wants even sides
    height, width = (max(round(side * scale) // 2 * 2, 4) for side in (frame.height, frame.width))
    pixels = _grey(frame, (height, width))
    # the variance of the Laplacian
    return float(laplace(pixels)[1:-1, 1:-1].var())


def _grey(frame: Any, size: tuple[int, int]) -> np.ndarray:
    grey = frame.reformat(width=size[1], height=size[0], format="gray").to_ndarray()
    return grey.astype(np.float32)


def _write(frame: Any, path: Path, aspect: float) -> None:
    """Write a frame as JPEG with square pixels, turned upright as the video's metadata says.

    aspect: width of a stored pixel over its height. HDR colours (HLG, PQ) become sRGB.
    """
    # where HDR has no primaries, they are those of nearly all HDR
    if frame.color_trc in _HDR and frame.color_primaries == ColorPrimaries.UNSPECIFIED:
        frame.color_primaries = ColorPrimaries.BT2020
    if frame.color_primaries == ColorPrimaries.BT2020:
        frame = _REFORMATTER.reformat(
            frame,
            format="rgb24",
            dst_color_primaries=ColorPrimaries.BT709,
            dst_color_trc=ColorTrc.IEC61966_2_1,
        )
    image = Image.fromarray(frame.to_ndarray(format="rgb24"))
    if aspect != 1:
        image = image.resize((round(aspect * image.width), image.height))
    # both count counterclockwise, in degrees
    if turn := round(frame.rotation / 90) % 4 * 90:
        image = image.rotate(turn, expand=True)
    image.save(path, quality=95, subsampling=0)
