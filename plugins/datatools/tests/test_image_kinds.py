"""Kinds of image files: read to known pixels or refused, in reading as in `qgs data check`."""

import io
import json
import struct
import zlib

import numpy as np
import pytest
import torch
from photo_formats import encoded, row_of_frames, scene
from PIL import Image
from qgs_datatools.check import Options, check
from upath import UPath

SIZE = (4, 6)
GREY = np.array([[0, 1, 127, 128, 254, 255]] * 4)
RGB = np.stack([GREY, GREY[:, ::-1], GREY.T[:4].repeat(2, 1)[:, :6]], -1).astype(np.uint8)
ORIENTATION = 0x0112


def photo_set(folder, data: bytes, suffix="png", **frame):
    """A folder of two photos with the same bytes; frame: keys of every frame."""
    (folder / "images").mkdir()
    listing = row_of_frames(2, fl_x=5.0, w=SIZE[1], h=SIZE[0])
    for i, entry in enumerate(listing["frames"]):
        entry.update(file_path=f"images/{i}.{suffix}", **frame)
        (folder / entry["file_path"]).write_bytes(data)
    (folder / "transforms.json").write_text(json.dumps(listing))
    return folder


def told(folder) -> list[str]:
    report = check(UPath(folder), Options(geometry=0, threads=1))
    return [str(f) for f in report.findings if f.severity == "error" and "point" not in str(f)]


def pixels(folder) -> np.ndarray:
    """(4, 6, 3) of the first photo."""
    read = scene(folder, SIZE).images([0])[0]
    return read.permute(1, 2, 0).mul(255).round().numpy()


def palette() -> Image.Image:
    return Image.fromarray(RGB).convert("P", palette=Image.Palette.ADAPTIVE, colors=256)


def colours_of_16_bits() -> bytes:
    """A PNG, which Pillow cannot write."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    rows = b"".join(b"\0" + row.tobytes() for row in (RGB.astype(np.uint32) * 257).astype(">u2"))
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", SIZE[1], SIZE[0], 16, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


def with_alpha(colors: np.ndarray) -> np.ndarray:
    return np.dstack([colors, np.full(SIZE, 255)]).astype(np.uint8)


BELOW = np.where(GREY[..., None] >= 128, 255, 0).repeat(3, -1)
READ = {
    "grey": (encoded(Image.fromarray(GREY.astype(np.uint8))), GREY),
    "grey of 16 bits": (encoded(Image.fromarray((GREY * 257).astype(np.uint16))), GREY),
    "grey TIFF of 16 bits": (
        encoded(Image.fromarray((GREY * 257).astype(np.uint16)), "TIFF"),
        GREY,
    ),
    "colours of 16 bits": (colours_of_16_bits(), RGB),
    "1 bit": (encoded(Image.fromarray(GREY >= 128)), BELOW),
    "colours": (encoded(RGB), RGB),
    "opaque alpha": (encoded(with_alpha(RGB)), RGB),
    "no alpha": (encoded(np.dstack([RGB, np.zeros(SIZE)]).astype(np.uint8)), RGB * 0 + 255),
    "grey and alpha": (
        encoded(Image.merge("LA", [Image.new("L", SIZE[::-1], 0), Image.new("L", SIZE[::-1], 51)])),
        np.full(SIZE, 204),
    ),
    "palette": (encoded(palette()), RGB),
    "CMYK": (
        encoded(Image.new("CMYK", SIZE[::-1], (255, 0, 51, 0)), "TIFF"),
        np.broadcast_to([0, 255, 204], (*SIZE, 3)),
    ),
}


@pytest.mark.parametrize("kind", READ)
def test_what_is_read_has_the_pixels_of_the_file(tmp_path, kind):
    data, expected = READ[kind]
    expected = expected if np.ndim(expected) == 3 else np.stack([expected] * 3, -1)
    folder = photo_set(tmp_path, data)
    np.testing.assert_array_equal(pixels(folder), expected)
    assert told(folder) == []


REFUSED = {
    "float TIFF": encoded(Image.fromarray(GREY.astype(np.float32)), "TIFF"),
    "32 bits": encoded(Image.fromarray(GREY.astype(np.int32)), "TIFF"),
    "LAB": encoded(Image.new("LAB", SIZE[::-1]), "TIFF"),
    "PostScript": encoded(RGB, "EPS"),
    "text": b"no image",
    "cut off": encoded(RGB)[:60],
}


@pytest.mark.parametrize("kind", REFUSED)
def test_what_is_refused_is_told_alike(tmp_path, kind):
    folder = photo_set(tmp_path, REFUSED[kind])
    with pytest.raises(ValueError, match=r"images/0\.png cannot be read as an image \((.*)\): "):
        pixels(folder)
    (line,) = told(folder)
    assert line.startswith(f"error: {folder.name}, frames 0-1 (images/0.png to images/1.png): the")


@pytest.mark.parametrize(("orientation", "quarters"), [(6, 3), (8, 1), (3, 2)])
def test_a_photo_turned_by_exif_is_read_upright(tmp_path, orientation, quarters):
    exif = Image.Exif()
    exif[ORIENTATION] = orientation
    folder = photo_set(tmp_path, encoded(RGB, exif=exif))
    upright = np.rot90(RGB, quarters)
    read = scene(folder, upright.shape[:2]).images([0])[0]
    np.testing.assert_array_equal(read.permute(1, 2, 0).mul(255).round().numpy(), upright)
    report = check(UPath(folder), Options(geometry=0, threads=1))
    assert not [f for f in report.findings if "EXIF" in str(f) or "listed as" in str(f)]


def test_a_photo_mirrored_by_exif_keeps_its_stored_pixels_and_a_warning_names_it(tmp_path, caplog):
    exif = Image.Exif()
    exif[ORIENTATION] = 2
    folder = photo_set(tmp_path, encoded(RGB, exif=exif))
    np.testing.assert_array_equal(pixels(folder), RGB)
    assert "EXIF orientation, which is not followed" in caplog.text
    report = check(UPath(folder), Options(geometry=0, threads=1))
    (line,) = (str(f) for f in report.findings if "EXIF" in str(f))
    assert line.startswith("warning: ")


def marked(value: int, dtype=np.uint8) -> Image.Image:
    """The right half is modelled, with this number."""
    mask = np.zeros(SIZE, dtype)
    mask[:, 3:] = value
    return Image.fromarray(mask)


COLORED = marked(1).convert("P")
COLORED.putpalette([0, 0, 0, 200, 10, 10])
MASKS = {
    "255": encoded(marked(255)),
    "1": encoded(marked(1)),
    "1 bit": encoded(marked(255).convert("1")),
    "16 bits": encoded(marked(65535, np.uint16)),
    "255 of 16 bits": encoded(marked(255, np.uint16)),
    "grey colours": encoded(marked(255).convert("RGB")),
    "grey palette": encoded(marked(255).convert("P")),
}
NO_MASKS = {
    "colours": encoded(Image.merge("RGB", [marked(255), marked(0), marked(0)])),
    "palette": encoded(COLORED),
    "alpha": encoded(Image.merge("LA", [marked(255), marked(255)])),
    "float": encoded(Image.fromarray(np.ones(SIZE, np.float32)), "TIFF"),
    "another aspect ratio": encoded(marked(255).resize((4, 6))),
    "text": b"no image",
}


def masked(folder, data: bytes):
    (folder / "mask.png").write_bytes(data)
    return photo_set(folder, encoded(RGB), mask_path="mask.png")


@pytest.mark.parametrize("kind", MASKS)
def test_masks(tmp_path, kind):
    folder = masked(tmp_path, MASKS[kind])
    read = scene(folder, SIZE).masks([0])
    assert read is not None
    assert torch.equal(read[0, 0], torch.tensor([[0, 0, 0, 1, 1, 1]] * 4).float())
    assert told(folder) == []


@pytest.mark.parametrize("kind", NO_MASKS)
def test_masks_that_are_refused(tmp_path, kind):
    folder = masked(tmp_path, NO_MASKS[kind])
    with pytest.raises(ValueError, match=r"mask\.png"):
        scene(folder, SIZE).masks([0])
    (line,) = told(folder)
    assert "mask.png" in line


def array(values: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, values, allow_pickle=True)
    return file.getvalue()


def false_header(*shape: int) -> bytes:
    file = io.BytesIO()
    header = {"descr": "<f4", "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(file, header)
    return file.getvalue()


METRES = np.arange(24).reshape(SIZE).astype(np.float32)
DEPTHS = {
    "16 bits": ("png", encoded(Image.fromarray((METRES * 1000).astype(np.uint16)))),
    "TIFF of 16 bits": ("tif", encoded(Image.fromarray((METRES * 1000).astype(">u2")), "TIFF")),
    "float TIFF": ("tif", encoded(Image.fromarray(METRES * 1000), "TIFF")),
    "32 bits": ("tif", encoded(Image.fromarray((METRES * 1000).astype(np.int32)), "TIFF")),
    "array": ("npy", array(METRES[..., None] * 1000)),
}
NO_DEPTHS = {
    "colours": ("png", encoded(RGB)),
    "1 bit": ("png", encoded(marked(255).convert("1"))),
    "objects": ("npy", array(np.array([[{}] * 6] * 4, object))),
    "a false header": ("npy", false_header(2000000, 1000000)),
    "cut off": ("npy", array(METRES)[:-4]),
    "another aspect ratio": ("npy", array(METRES.T)),
    "text": ("npy", b"no array"),
}


def deep(folder, suffix: str, data: bytes):
    (folder / f"depth.{suffix}").write_bytes(data)
    return photo_set(folder, encoded(RGB), depth_file_path=f"depth.{suffix}")


@pytest.mark.parametrize("kind", DEPTHS)
def test_depth_maps(tmp_path, kind):
    folder = deep(tmp_path, *DEPTHS[kind])
    read = scene(folder, SIZE).depths([0])
    assert read is not None
    np.testing.assert_allclose(read[0, 0], METRES, rtol=1e-6)
    assert told(folder) == []


@pytest.mark.parametrize("kind", NO_DEPTHS)
def test_depth_maps_that_are_refused(tmp_path, kind):
    folder = deep(tmp_path, *NO_DEPTHS[kind])
    with pytest.raises(ValueError, match=r"depth\.(png|npy)"):
        scene(folder, SIZE).depths([0])
    (line,) = told(folder)
    assert "depth." in line
