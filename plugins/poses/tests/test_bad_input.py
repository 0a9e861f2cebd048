"""What people give: each kind ends with poses or with one sentence, and theirs stays as it was."""

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import av
import numpy as np
import pytest
from commands import run_qgs
from PIL import Image, ImageFilter, ImageOps
from qgs_poses import making
from qgs_poses.making import read_record
from test_frames import rotated, write_sound
from walked import PHOTOS, write_video

from qgs.io.files import DiskFullError

pytestmark = pytest.mark.slow
ORIENTATION, EXIF_IFD, FOCAL = 0x0112, 0x8769, 0x920A
Pictures = list[np.ndarray]


def each(name: str = "{}.jpg", change: Callable = lambda image, number: image, **options: object):
    """Makes a folder of the photos, each changed. options: of saving it."""

    def write(folder: Path, images: Pictures) -> Path:
        for number, image in enumerate(images):
            changed = change(Image.fromarray(image), number)
            settings = {"quality": 95} if name.lower().endswith("jpg") else {}
            changed.save(folder / name.format(number), **{**settings, **options})
        return folder

    return write


def then(*steps: Callable) -> Callable:
    """One after the other."""

    def write(folder: Path, images: Pictures) -> Path:
        source = folder
        for step in steps:
            source = step(folder, images) or source
        return source

    return write


def raw(name: str, data: bytes) -> Callable:
    return lambda folder, images: (folder / name).write_bytes(data) and None


def cut(name: str, part: float) -> Callable:
    def write(folder: Path, images: Pictures) -> None:
        data = (folder / name).read_bytes()
        (folder / name).write_bytes(data[: int(len(data) * part)])

    return write


def only(number: int) -> Callable:
    return lambda folder, images: each()(folder, images[:number])


def exif_of(**tags: int) -> Image.Exif:
    exif = Image.Exif()
    if "orientation" in tags:
        exif[ORIENTATION] = tags["orientation"]
    if "focal" in tags:
        exif.get_ifd(EXIF_IFD)[FOCAL] = float(tags["focal"])
    return exif


def zoomed(folder: Path, images: Pictures) -> None:
    """Half of the photos are taken with twice the focal length, as EXIF says."""
    for number, image in enumerate(images):
        photo = Image.fromarray(image)
        if number % 2:
            height, width = image.shape[:2]
            photo = photo.crop((width // 4, height // 4, 3 * width // 4, 3 * height // 4))
            photo = photo.resize((width, height), Image.Resampling.LANCZOS)
        exif = exif_of(focal=50 if number % 2 else 25)
        photo.save(folder / f"{number}.jpg", quality=95, exif=exif)


def two_scenes(folder: Path, images: Pictures) -> None:
    each()(folder, images)
    for number, image in enumerate(images[:5]):
        # other walls: the colours of the pixels of a block are shuffled the same way in all photos
        Image.fromarray(image[::-1, :, ::-1].copy()).save(folder / f"other{number}.jpg", quality=95)


def strangers(folder: Path, images: Pictures) -> None:
    """Textured photos of nothing in common."""
    for number in range(6):
        rng = np.random.default_rng(number)
        small = rng.integers(0, 255, (30, 45, 3), np.uint8)
        photo = Image.fromarray(small).resize((540, 360), Image.Resampling.BICUBIC)
        photo.save(folder / f"{number}.png")


def video(name: str, codec: str = "libx264", frames: Callable = lambda images: images) -> Callable:
    def write(folder: Path, images: Pictures) -> Path:
        pictures = frames(images)
        with av.open(str(folder / name), "w") as container:
            stream = container.add_stream(codec, rate=10, options={"crf": "15", "g": "4"})
            stream.height, stream.width = pictures[0].shape[:2]
            stream.pix_fmt = "yuv420p"
            for picture in pictures:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(picture)))
            container.mux(stream.encode())
        return folder / name

    return write


def turned_video(folder: Path, images: Pictures) -> Path:
    plain = write_video(folder / "plain.mp4", images)
    (folder / "turned.mp4").write_bytes(rotated(plain.read_bytes(), 90))
    plain.unlink()
    return folder / "turned.mp4"


def silent(folder: Path, images: Pictures) -> Path:
    write_sound(folder / "a.mp4")
    return folder / "a.mp4"


def in_images(folder: Path, images: Pictures) -> None:
    (folder / "images").mkdir()
    each()(folder / "images", images)


def linked(folder: Path, images: Pictures) -> None:
    elsewhere = folder.with_name("elsewhere")
    elsewhere.mkdir()
    each()(elsewhere, images)
    for file in elsewhere.iterdir():
        (folder / file.name).symlink_to(file)


def huge(folder: Path, images: Pictures) -> None:
    each()(folder, images)
    Image.fromarray(images[0]).resize((12000, 8000)).save(folder / "huge.jpg")


JPEG_WITH_BAD_EXIF = each(exif=b"Exif\0\0MM\0*\0\0\0\x08\xff\xff" + bytes(30))

KINDS: dict[str, tuple[Callable, int]] = {
    # what is given, and how many photos get poses at least; 0: it is refused
    "an empty folder": (lambda folder, images: folder, 0),
    "two photos": (only(2), 0),
    "one view many times": (lambda folder, images: each()(folder, [images[0]] * 5), 0),
    "every photo twice": (lambda folder, images: each()(folder, [*images, *images]), 16),
    "mirrored photos": (each(change=lambda image, _: ImageOps.mirror(image)), 8),
    "half of them mirrored": (
        each(change=lambda image, n: ImageOps.mirror(image) if n < 3 else image), 5,
    ),
    "ten pixels": (each(change=lambda image, _: image.resize((10, 10))), 0),
    "one of 96 megapixels": (huge, 8),
    "CMYK": (each(change=lambda image, _: image.convert("CMYK")), 8),
    "16 bits": (each("{}.png", lambda image, _: Image.fromarray(
        np.array(image.convert("L")).astype(np.uint16) * 257)), 8),
    "grey": (each(change=lambda image, _: image.convert("L")), 8),
    "a palette": (each("{}.png", lambda image, _: image.convert("P")), 6),
    "transparent": (each("{}.png", lambda image, _: image.convert("RGBA")), 8),
    "WebP": (each("{}.webp", quality=95), 8),
    "TIFF": (each("{}.tif"), 8),
    "BMP": (each("{}.bmp"), 8),
    "GIF": (each("{}.gif"), 0),
    "HEIC alone": (then(*(raw(f"{n}.heic", b"ftypheic" * 9) for n in range(5))), 0),
    "HEIC among others": (then(each(), raw("x.HEIC", b"ftypheic" * 9)), 8),
    "two scenes": (two_scenes, 8),
    "signs in names": (each("Fo’to #{} %20 'ä'.jpg"), 8),
    "capital suffixes": (each("IMG_{}.JPG"), 8),
    "one cut off": (then(each(), cut("3.jpg", 0.4)), 6),
    "all cut off": (then(each(), *(cut(f"{n}.jpg", 0.2) for n in range(PHOTOS))), 0),
    "an empty file": (then(each(), raw("x.jpg", b"")), 8),
    "a text": (then(each(), raw("x.jpg", b"no photo")), 8),
    "damaged EXIF": (JPEG_WITH_BAD_EXIF, 8),
    "mixed orientations": (
        lambda folder, images: [
            Image.fromarray(image).transpose(Image.Transpose.ROTATE_90).save(
                folder / f"{n}.jpg", quality=95, exif=exif_of(orientation=6))
            if n % 2 else Image.fromarray(image).save(folder / f"{n}.jpg", quality=95)
            for n, image in enumerate(images)
        ] and folder, 8,
    ),
    "two sizes": (
        each(change=lambda image, n: image.resize((360, 240)) if n % 2 else image), 7,
    ),
    "two focal lengths": (zoomed, 4),
    "blurred": (each(change=lambda image, _: image.filter(ImageFilter.GaussianBlur(60))), 0),
    "white": (each(change=lambda image, _: Image.new("RGB", image.size, "white")), 0),
    "nothing in common": (strangers, 0),
    "links": (linked, 8),
    "in a folder images": (in_images, 8),
    "a folder called x.jpg": (then(each(), lambda f, i: (f / "x.jpg").mkdir()), 8),
    "hidden files": (then(each(), raw("._0.jpg", b"\0\5\x16\7")), 8),
    "an H.264 video": (video("a.mp4"), 8),
    "an HEVC video": (video("a.mov", "libx265"), 8),
    "a VP9 video": (video("a.webm", "libvpx-vp9"), 8),
    "an AV1 video": (video("a.mkv", "libsvtav1"), 8),
    "a turned video": (turned_video, 8),
    "a cut off mp4": (then(video("a.mp4"), cut("a.mp4", 0.5)), 0),
    "a cut off mkv": (then(video("a.mkv"), cut("a.mkv", 0.7)), 3),
    "a video of one frame": (video("a.mp4", frames=lambda images: images[:1]), 0),
    "a still video": (video("a.mp4", frames=lambda images: images[:1] * 60), 0),
    "a text called mp4": (then(raw("a.mp4", b"no video" * 50), lambda f, i: f / "a.mp4"), 0),
    "an empty video": (then(raw("a.mp4", b"\0"), lambda f, i: f / "a.mp4"), 0),
    "sound": (silent, 0),
}  # fmt: skip


def state(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.mark.parametrize("kind", KINDS)
def test_it_ends_with_poses_or_with_a_sentence(kind, shots, tmp_path):
    write, least = KINDS[kind]
    folder = tmp_path / "given here"
    folder.mkdir()
    try:
        source = write(folder, [shot.image for shot in shots]) or folder
    except (ValueError, OSError) as error:
        if "codec" not in str(error).lower():
            raise
        pytest.skip(f"this build of FFmpeg has no encoder for it: {error}")
    before, out = state(folder), tmp_path / "out"
    result = run_qgs("poses", source, "--out", out)
    assert state(folder) == before
    if not least:
        assert isinstance(result.exception, ValueError), (result.output, result.exception)
        assert str(result.exception).count("\n") == 0
        assert not out.exists()
        return
    assert result.exit_code == 0, (result.output, result.exception)
    record = read_record(out)
    assert record is not None
    assert len(record["posed"]) >= least, result.output
    assert not (out / "working").exists()


def test_what_cannot_be_written_is_named(walk, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("mine")
    for out in (tmp_path / "file" / "out", Path("/proc/out")):
        assert isinstance(run_qgs("poses", walk, "--out", out).exception, OSError)

    def full(*rest: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(making, "prepare", full)
        result = run_qgs("poses", walk, "--out", tmp_path / "out")
    assert isinstance(result.exception, DiskFullError)
    assert run_qgs("poses", walk, "--out", tmp_path / "out").exit_code == 0


COMMAND = "import sys; from qgs.cli import main; sys.argv[0] = 'qgs'; main()"


def started(walk: Path, out: Path, stage: str) -> subprocess.Popen:
    """`qgs poses` in the stage."""
    command = [sys.executable, "-uc", COMMAND, "poses", str(walk), "--out", str(out)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert process.stdout is not None
    for line in process.stdout:
        if line.startswith(stage):
            break
    return process


@pytest.mark.parametrize("stage", ["photos", "features", "matching", "mapping"])
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_one_that_is_ended_in_a_stage_is_finished_by_the_same_command(stage, how, walk, tmp_path):
    process = started(walk, tmp_path / "out", stage)
    process.send_signal(how)
    text, _ = process.communicate(timeout=60)
    assert process.returncode
    if how == signal.SIGINT:
        assert "Traceback" not in text
        assert "goes on from there" in text
    time.sleep(0.5)  # the process of COLMAP ends by itself
    result = run_qgs("poses", walk, "--out", tmp_path / "out")
    assert result.exit_code == 0, (result.output, result.exception)
    record = read_record(tmp_path / "out")
    assert record is not None
    assert len(record["posed"]) == PHOTOS


def test_a_crash_of_colmap_is_one_sentence(walk, tmp_path):
    process = started(walk, tmp_path / "out", "features")
    found = subprocess.run(
        ["ps", "-o", "pid=", "--ppid", str(process.pid)], capture_output=True, text=True, check=True
    )
    (child,) = found.stdout.split()
    os.kill(int(child), signal.SIGSEGV)
    text, _ = process.communicate(timeout=60)
    assert process.returncode == 2
    assert "error: COLMAP ended in the stage" in text
    assert "Traceback" not in text
    assert run_qgs("poses", walk, "--out", tmp_path / "out").exit_code == 0


def test_two_at_once_do_not_mix(walk, tmp_path):
    process = started(walk, tmp_path / "out", "features")
    second = run_qgs("poses", walk, "--out", tmp_path / "out")
    process.communicate(timeout=120)
    assert process.returncode == 0
    assert isinstance(second.exception, FileExistsError)


def test_photos_on_another_file_system_are_copied(walk, tmp_path, monkeypatch):
    monkeypatch.setattr(os, "link", lambda *rest: (_ for _ in ()).throw(OSError(18, "cross")))
    copied = shutil.copytree(walk, tmp_path / "photos")
    assert run_qgs("poses", copied, "--out", tmp_path / "out").exit_code == 0
    assert {f.stat().st_nlink for f in (tmp_path / "out" / "images").iterdir()} == {1}
