"""What tests of poses share."""

from fractions import Fraction

import av
import numpy as np
from photo_formats import write_photos as write_photos
from rich.console import Console
from upath import UPath

from qgs.data.photos import read_listing

QUIET = Console(quiet=True)
SCALE = 2
PHOTOS = 6
"""Size of the photos over that of `textured_room`, and how many there are."""


def write_video(path, images, rate=10, codec="libx264", times=None, **options):
    """A video of images of one size. times: of these, in parts of a second as `rate` has them."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=rate, options={"crf": "15"} | options)
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        for number, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(image)
            if times:
                frame.pts = times[number]
                frame.time_base = Fraction(1, rate)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def frames(path):
    """What a video shows, as RGB."""
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def write_turned(path, images, degrees):
    """An mp4 whose track says that it is shown `degrees` clockwise: the matrix in `tkhd`."""
    data = write_video(path, images).read_bytes()
    turn = 1j ** (degrees // 90)
    matrix = 65536 * np.array([turn.real, turn.imag, 0, -turn.imag, turn.real, 0, 0, 0])
    start = data.index(b"tkhd") + 4 + 40  # version 0: 40 bytes before the matrix
    path.write_bytes(data[:start] + matrix.astype(">i4").tobytes() + data[start + 32 :])
    return path


def relative(c2w):
    """Poses in the first one's frame, positions in parts of the farthest one's distance."""
    found = np.linalg.inv(c2w[0]) @ c2w
    found[:, :3, 3] /= np.linalg.norm(found[:, :3, 3], axis=1).max()
    return found


def assert_close(folder, shots):
    """Within a degree, .0175, and two hundredths of the extent; of two photos, within two."""
    frames = read_listing(UPath(folder)).frames
    assert len(frames) == len(shots)
    found, true = (relative(np.stack([one.c2w for one in each])) for each in (frames, shots))
    assert np.median(np.linalg.norm(found - true, axis=(1, 2))) < 0.0175
