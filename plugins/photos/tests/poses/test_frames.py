"""Photos made ready, and frames of videos: which are taken, that they are upright."""

import os
from pathlib import Path

import numpy as np
import pytest
from photo_formats import cut, noise
from PIL import Image, ImageFilter
from qgs_photos.poses.frames import FEWEST, extract, thinned
from qgs_photos.poses.photos import camera_groups, photo_files, prepare
from walked import write_photos, write_turned, write_video


def numbered_images(count):
    """Each with its number as grey level, and edges."""
    images = np.full((count, 96, 128, 3), 20, np.uint8)
    images += 4 * np.arange(count, dtype=np.uint8)[:, None, None, None]
    images[:, ::8] = 255
    return [*images]


def levels(folder):
    """The numbers of the images that the frames show."""
    frames = [np.array(Image.open(path))[4::8] for path in sorted(folder.glob("*.jpg"))]
    return [round((float(np.median(frame)) - 20) / 4) for frame in frames]


def test_the_sharpest_frame_of_each_interval_is_taken(tmp_path):
    images = numbered_images(40)
    sharp = [3, 12, 19, 28, 33]
    for number in {*range(40)} - {*sharp}:
        blurred = Image.fromarray(images[number]).filter(ImageFilter.GaussianBlur(3))
        images[number] = np.array(blurred)
    assert extract(write_video(tmp_path / "a.mp4", images, crf="1"), tmp_path, 5) == []
    assert levels(tmp_path) == sharp


def test_videos_of_other_kinds_are_read(tmp_path):
    images = numbered_images(12)
    for name, codec in (("a.mov", "libx265"), ("a.webm", "libvpx-vp9"), ("a.mkv", "libsvtav1")):
        extract(write_video(tmp_path / name, images, codec=codec), tmp_path, 4)
        assert levels(tmp_path) == [0, 3, 6, 9], name


def test_a_picture_that_moves_fast_gives_more_frames(tmp_path):
    wide = noise(12, 100, 3).repeat(8, 0).repeat(8, 1)
    counts = []
    for step in (0, 8):  # pixels of 128
        images = [np.ascontiguousarray(wide[:, step * n : step * n + 128]) for n in range(80)]
        folder = tmp_path / str(step)
        folder.mkdir()
        extract(write_video(folder / "a.mp4", images, rate=20), folder)
        counts.append(len([*folder.glob("*.jpg")]))
    assert counts[0] == FEWEST
    assert 60 <= counts[1] <= 80


def test_of_more_frames_than_wanted_the_sharpest_of_neighbours_are_kept():
    scores = {Path(f"{n:05d}.jpg"): float(n % 5 == 2) for n in range(50)}
    assert [int(path.stem) for path in thinned(scores, 10)] == [*range(2, 50, 5)]
    assert thinned(scores, 50) == [*scores]
    assert len(thinned(scores, 33)) == 33


def test_a_varying_rate_counts_by_time(tmp_path):
    """The first 20 frames pass in .2 s, the last 10 in 10 s."""
    times = [*range(20), *range(20, 1020, 100)]
    video = write_video(tmp_path / "a.mp4", numbered_images(30), 100, times=times, bf="0")
    extract(video, tmp_path, 5)
    assert sum(number >= 20 for number in levels(tmp_path)) >= 4


def test_a_turned_phone_gives_upright_frames(tmp_path):
    image = np.zeros((64, 96, 3), np.uint8)
    image[:32, :48] = 255  # bright at the upper left
    for degrees in (90, 180, 270):
        extract(write_turned(tmp_path / "a.mp4", [image] * 6, degrees), tmp_path, 3)
        found = Image.open(tmp_path / "00001.jpg").convert("L")
        expected = Image.fromarray(image).convert("L").rotate(-degrees, expand=True)
        assert found.size == expected.size
        assert np.abs(np.array(found, float) - np.array(expected, float)).mean() < 4


@pytest.mark.parametrize("name", ["hlg.mov", pytest.param("pq.mov", marks=pytest.mark.slow)])
def test_hdr_videos_look_as_others(tmp_path, name):
    """The video in HLG does not say which primaries it has."""
    shown = []
    for video in ("bt709.mp4", name):
        extract(Path(__file__).parent / "videos" / video, tmp_path, 3)
        shown.append(np.array(Image.open(tmp_path / "00000.jpg"), float))
    assert np.abs(shown[1] - shown[0]).mean() < 4


def test_pixels_of_a_video_become_square(tmp_path):
    images = numbered_images(6)
    extract(write_video(tmp_path / "a.mp4", images, **{"x264-params": "sar=3/2"}), tmp_path, 3)
    assert Image.open(tmp_path / "00000.jpg").size == (192, 96)


def test_a_broken_tail_costs_its_frames(tmp_path):
    video = cut(write_video(tmp_path / "a.mkv", numbered_images(55), g="5"), 0.6)
    remarks = extract(video, tmp_path, 12)
    found = levels(tmp_path)
    assert len(found) >= 5
    assert max(found) < 50
    assert "5.5 s" in remarks[0]


@pytest.fixture
def folders(tmp_path):
    """Of photos, of those that are kept, and of those for COLMAP."""
    folders = [tmp_path / name for name in ("images", "kept", "small")]
    for folder in folders:
        folder.mkdir()
    return folders


def test_photos_are_in_the_order_of_their_numbers_and_so_are_their_names_as_text(folders):
    photos, kept, small = folders
    images = [np.full((80, 100, 3), 10 * number, np.uint8) for number in range(12)]
    write_photos(photos, images, "IMG {}.png")
    ready, faulty = prepare(photo_files(photos), kept, small, 1000)
    assert not faulty
    names = [f"{number:02}_IMG {number}.png" for number in range(12)]
    assert [photo.name for photo in ready] == names
    for folder in (kept, small):
        assert np.array_equal([np.array(Image.open(folder / name)) for name in names], images)


def test_files_of_the_user_are_linked_or_copied(folders, monkeypatch):
    photos, kept, small = folders
    write_photos(photos, np.full((3, 80, 100, 3), 90, np.uint8))
    files = photo_files(photos.parent)  # in a folder `images`
    prepare(files, kept, small, 70)
    assert Image.open(small / "0.png").size == (70, 56)
    assert files[0].samefile(kept / "0.png")

    def refused(*rest):
        raise OSError(18, "Invalid cross-device link")

    monkeypatch.setattr(os, "link", refused)
    (kept / "0.png").unlink()
    prepare(files[:1], kept, small, 70)
    assert not files[0].samefile(kept / "0.png")
    assert (kept / "0.png").read_bytes() == files[0].read_bytes()


def test_photos_of_one_size_and_focal_length_share_a_camera(folders):
    photos, kept, small = folders
    for name, focal, width in (
        ("a", 25.0, 100),
        ("b", 50.0, 100),
        ("c", 25.0, 100),
        ("d", 25.0, 90),
    ):
        exif = Image.Exif()
        exif.get_ifd(0x8769)[0x920A] = focal
        Image.new("RGB", (width, 80)).save(photos / f"{name}.jpg", exif=exif)
    damaged = b"Exif\0\0MM\0*\0\0\0\x08\xff\xff" + bytes(30)
    Image.new("RGB", (100, 80)).save(photos / "e.jpg", exif=damaged)
    ready, _ = prepare(photo_files(photos), kept, small, 1000)
    assert camera_groups(ready) == [["a.jpg", "c.jpg"], ["b.jpg"], ["d.jpg"], ["e.jpg"]]
