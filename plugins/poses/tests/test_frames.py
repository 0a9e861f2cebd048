"""Frames of videos: which are taken, that they are upright, and what a damaged file costs."""

from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image, ImageFilter
from qgs_poses.frames import FEWEST, extract, shift, thinned
from qgs_poses.photos import PosesError
from walked import write_video


def numbered_images(count: int, size: tuple[int, int] = (96, 128)) -> list[np.ndarray]:
    """Each with its number as grey level, and edges."""
    images = []
    for number in range(count):
        image = np.full((*size, 3), 20 + 4 * number, np.uint8)
        image[::8] = 255
        images.append(image)
    return images


def level(path) -> int:
    """The number of the image that a frame shows."""
    return round((float(np.median(np.array(Image.open(path))[4::8])) - 20) / 4)


def test_the_sharpest_frame_of_each_interval_is_taken(tmp_path):
    images = numbered_images(40)
    sharp = {3, 12, 19, 28, 33}
    for number in set(range(40)) - sharp:
        blurred = Image.fromarray(images[number]).filter(ImageFilter.GaussianBlur(3))
        images[number] = np.array(blurred)
    video = write_video(tmp_path / "a.mp4", images, crf="1")
    assert extract(video, tmp_path, 5) == []
    found = {level(path) for path in tmp_path.glob("*.jpg")}
    assert found == sharp


def test_a_long_video_gives_even_intervals(tmp_path):
    video = write_video(tmp_path / "a.mp4", numbered_images(50), crf="1")
    extract(video, tmp_path, 10)
    levels = [level(path) for path in sorted(tmp_path.glob("*.jpg"))]
    assert [n // 5 for n in levels] == [*range(10)]


def test_a_picture_that_moves_fast_gives_more_frames(tmp_path):
    rng = np.random.default_rng(0)
    wide = rng.integers(0, 255, (12, 200, 3), np.uint8).repeat(8, 0).repeat(8, 1)
    counts = []
    for step in (0, 6):  # pixels of 128
        images = [np.ascontiguousarray(wide[:, step * n : step * n + 128]) for n in range(120)]
        video = write_video(tmp_path / f"{step}.mp4", images, rate=30)
        (tmp_path / str(step)).mkdir()
        extract(video, tmp_path / str(step))
        counts.append(len([*(tmp_path / str(step)).glob("*.jpg")]))
    assert counts[0] == FEWEST
    assert 60 <= counts[1] <= 120


def test_of_more_frames_than_wanted_the_sharpest_of_neighbours_are_kept():
    scores = {Path(f"{n:05d}.jpg"): float(n % 5 == 2) for n in range(50)}
    assert [int(path.stem) for path in thinned(scores, 10)] == [*range(2, 50, 5)]
    assert thinned(scores, 50) == [*scores]
    assert len(thinned(scores, 33)) == 33


def test_the_shift_of_a_picture():
    rng = np.random.default_rng(0)
    wide = np.kron(rng.random((12, 40)), np.ones((4, 4))).astype(np.float32)
    assert shift(wide[:, :64], wide[:, 8:72]) == pytest.approx(8 / 64)
    assert shift(wide[:, :64], wide[:, :64]) == 0


def test_a_varying_rate_counts_by_time(tmp_path):
    path = tmp_path / "a.mp4"
    images = numbered_images(30)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=100, options={"crf": "15", "bf": "0"})
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        for number, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(image)
            # the first 20 frames pass in .2 s, the last 10 in 10 s
            frame.pts = number if number < 20 else 20 + 100 * (number - 20)
            frame.time_base = Fraction(1, 100)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    extract(path, tmp_path, 5)
    levels = [level(found) for found in sorted(tmp_path.glob("*.jpg"))]
    assert sum(number >= 20 for number in levels) >= 4


@pytest.mark.parametrize("degrees", [90, 180, 270])
def test_a_turned_phone_gives_upright_frames(degrees, tmp_path):
    image = np.zeros((64, 96, 3), np.uint8)
    image[:32, :48] = 255  # bright at the upper left
    plain = write_video(tmp_path / "plain.mp4", [image] * 6)
    turned = tmp_path / "turned.mp4"
    turned.write_bytes(rotated(plain.read_bytes(), degrees))
    extract(turned, tmp_path, 3)
    found = Image.open(tmp_path / "00001.jpg").convert("L")
    expected = Image.fromarray(image).convert("L").rotate(-degrees, expand=True)
    assert found.size == expected.size
    assert np.abs(np.array(found, float) - np.array(expected, float)).mean() < 4


def rotated(data: bytes, degrees: int) -> bytes:
    """An mp4 whose track says that it is shown `degrees` clockwise: the matrix in `tkhd`."""
    cosine, sine = {90: (0, 1), 180: (-1, 0), 270: (0, -1)}[degrees]
    matrix = (cosine, sine, 0, -sine, cosine, 0, 0, 0)
    start = data.index(b"tkhd") + 4 + 40  # version 0: 40 bytes before the matrix
    numbers = b"".join(int(n * 65536).to_bytes(4, "big", signed=True) for n in matrix)
    return data[:start] + numbers + data[start + 32 :]


def test_a_broken_tail_costs_its_frames(tmp_path):
    video = tmp_path / "a.mkv"
    write_video(video, numbered_images(55), g="5")
    data = video.read_bytes()
    video.write_bytes(data[: len(data) * 6 // 10])
    remarks = extract(video, tmp_path, 12)
    count = len([*tmp_path.glob("*.jpg")])
    assert count >= 5
    assert all(level(path) < 50 for path in tmp_path.glob("*.jpg"))
    assert count == 12 or remarks


@pytest.mark.parametrize("kind", ["empty", "text", "one frame", "cut off", "sound"])
def test_what_is_no_video_is_refused(kind, tmp_path):
    path = tmp_path / "a.mp4"
    if kind in ("one frame", "cut off"):
        write_video(path, numbered_images(1 if kind == "one frame" else 30))
    if kind == "sound":
        write_sound(path)
    if kind in ("empty", "text"):
        path.write_bytes({"empty": b"", "text": b"no video" * 40}[kind])
    if kind == "cut off":  # an mp4 lacks its index then, which stands at the end
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(PosesError):
        extract(path, tmp_path, 5)


def write_sound(path) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("aac", rate=8000, layout="mono")
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), "fltp", "mono")
        frame.rate = 8000
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
