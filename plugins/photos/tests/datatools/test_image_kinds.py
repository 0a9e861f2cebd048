"""Kinds of image files: read to known pixels or refused, in reading as in `qgs data check`."""

import io
import re

import av
import numpy as np
import pytest
from photo_formats import encoded, scene, turned, write_row
from PIL import Image
from planted import checked
from tables import assert_near, must_refuse

SIZE = (4, 6)
GREY = np.uint8([[0, 1, 127, 128, 254, 255]] * 4)
RGB = np.stack([GREY, GREY[:, ::-1], GREY.T[:4].repeat(2, 1)[:, :6]], -1)
MASK = np.uint8([[0, 0, 0, 1, 1, 1]] * 4)
WHITE = Image.fromarray(255 * MASK)  # where the mask is 1
METRES = np.arange(24, dtype=np.float32).reshape(SIZE)
MILLIMETRES = 1000 * METRES


def photos(folder, files, key="file_path"):
    """Photos as they are read, and what is found of them.

    files: by name, what each frame has: bytes, or pixels, which are written as the name says.
    """
    write_row(folder, [RGB] * len(files), cameras=[{key: x} for x in files], fl_x=5.0, w=6, h=4)
    for name, data in files.items():
        if not isinstance(data, bytes):
            data = encoded(data, "TIFF" if name.endswith("tif") else "PNG")
        (folder / name).write_bytes(data)
    return scene(folder, SIZE), checked(folder, geometry=0).findings


def wide(values, factor):
    """Numbers of 16 bits."""
    return np.uint16(values) * np.uint16(factor)


def colours_of_16_bits():
    """A PNG, which Pillow cannot write."""
    codec = av.CodecContext.create("png", "w")
    codec.height, codec.width = SIZE
    codec.pix_fmt = "rgb48be"
    codec.framerate = 1
    return b"".join(map(bytes, codec.encode(av.VideoFrame.from_ndarray(wide(RGB, 257), "rgb48be"))))


def with_alpha(alpha):
    return np.dstack([RGB, 0 * GREY + np.uint8(alpha)])


def palette(pixels):
    return Image.fromarray(pixels).convert("P", palette=Image.Palette.ADAPTIVE)


def plain(mode, color):
    return Image.new(mode, SIZE[::-1], color)


def array(values):
    file = io.BytesIO()
    np.save(file, values)
    return file.getvalue()


IMAGES = {
    "grey.png": (GREY, GREY),
    "grey of 16 bits.png": (wide(GREY, 257), GREY),
    "grey of 16 bits.tif": (wide(GREY, 257), GREY),
    "colours of 16 bits.png": (colours_of_16_bits(), RGB),
    "1 bit.png": (GREY >= 128, 255 * (GREY >= 128)),
    "colours.png": (RGB, RGB),
    "opaque alpha.png": (with_alpha(255), RGB),
    "no alpha.png": (with_alpha(0), 0 * GREY + 255),
    "grey and alpha.png": (plain("LA", (0, 51)), 0 * GREY + 204),
    "palette.png": (palette(RGB), RGB),
    "CMYK.tif": (plain("CMYK", (255, 0, 51, 0)), 0 * RGB + np.uint8([0, 255, 204])),
}
MASKS = {
    "255.png": WHITE,
    "1.png": MASK,
    "1 bit.png": MASK > 0,
    "16 bits.png": wide(MASK, 65535),
    "255 of 16 bits.png": wide(MASK, 255),
    "grey colours.png": WHITE.convert("RGB"),
    "grey palette.png": WHITE.convert("P"),
}
DEPTHS = {
    "16 bits.png": np.uint16(MILLIMETRES),
    "16 bits.tif": MILLIMETRES.astype(">u2"),
    "float.tif": MILLIMETRES,
    "32 bits.tif": np.int32(MILLIMETRES),
    "array.npy": array(MILLIMETRES[..., None]),
}
NO_IMAGES = {
    "float.tif": METRES,
    "32 bits.tif": np.int32(GREY),
    "LAB.tif": plain("LAB", 0),
    "PostScript.png": encoded(RGB, "EPS"),
    "text.png": b"no image",
    "cut off.png": encoded(RGB)[:60],
}
NO_MASKS = {
    "colours.png": MASK[..., None] * np.uint8([255, 0, 0]),
    "palette.png": palette(MASK[..., None] * np.uint8([200, 10, 10])),
    "alpha.png": plain("LA", (255, 128)),
    "float.tif": np.float32(MASK),
    "another aspect ratio.png": WHITE.resize(SIZE),
    "text.png": b"no image",
}
NO_DEPTHS = {
    "colours.png": RGB,
    "1 bit.png": MASK > 0,
    "objects.npy": array(np.array([[{}] * 6] * 4, object)),
    "false header.npy": array(METRES).replace(b"(4, 6), }", b"(2000000, 1000000), }"),
    "cut off.npy": array(METRES)[:-4],
    "another aspect ratio.npy": array(METRES.T),
    "text.npy": b"no array",
}
KINDS = {
    "images": ("file_path", 255, IMAGES, NO_IMAGES),
    "masks": ("mask_path", 1, {name: (data, MASK) for name, data in MASKS.items()}, NO_MASKS),
    "depths": (
        "depth_file_path", 1, {name: (data, METRES) for name, data in DEPTHS.items()}, NO_DEPTHS
    ),
}  # fmt: skip


@pytest.mark.parametrize("method", KINDS)
def test_what_is_read_has_the_pixels_of_the_file(method, tmp_path):
    key, factor, files, _ = KINDS[method]
    read, findings = photos(tmp_path, {name: data for name, (data, _) in files.items()}, key)
    assert not findings
    for frame, (name, (_, expected)) in enumerate(files.items()):
        found = getattr(read, method)([frame])[0].movedim(0, -1) * factor
        assert np.allclose(found, expected.reshape(*SIZE, -1), 1e-6, 0), name


@pytest.mark.parametrize("method", KINDS)
def test_what_is_refused_is_told_alike(method, tmp_path):
    key, _, _, files = KINDS[method]
    read, (finding,) = photos(tmp_path, files, key)
    for frame, name in enumerate(files):
        must_refuse(re.escape(name), getattr(read, method), [frame])
    assert finding.severity == "error"
    assert [frame for frame, *_ in finding.photos] == [*range(len(files))]
    assert next(iter(files)) in str(finding)


def test_a_photo_mirrored_by_exif_keeps_its_stored_pixels_and_a_warning_names_it(tmp_path, caplog):
    data = encoded(RGB, exif=turned(2))
    read, (finding,) = photos(tmp_path, {"a.png": data, "b.png": data})
    assert_near(read.images([0])[0].movedim(0, -1) * 255, RGB)
    assert "EXIF orientation, which is ignored" in caplog.text
    assert finding.severity == "warning"
    assert "EXIF" in str(finding)
