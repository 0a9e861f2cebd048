"""COLMAP models handed to pycolmap: whole, without points, from any file system.

pycolmap reads local folders alone, wants points, and takes what memory holds for what a truncated
file lacks. So a copy is staged for it: files are checked to be whole on the way, and observations
and points, which cameras do not need and which are most of a model, are left out.
"""

from __future__ import annotations

import struct
import tempfile
from collections.abc import Iterator, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import IO, TYPE_CHECKING

from upath import UPath

from qgs.contracts.component import MissingExtraError

if TYPE_CHECKING:
    import pycolmap

BINARY = ("cameras.bin", "images.bin")
TEXT = ("cameras.txt", "images.txt")
_POINTS_OF_AN_IMAGE = 24  # bytes of x, y and the point's number
_LONGEST_NAME = 4096


def files_of(folder: UPath) -> tuple[str, str] | None:
    """The files of the model in `folder`, binary before text; None without a model."""
    for files in (BINARY, TEXT):
        if all((folder / file).is_file() for file in files):
            return files
    return None


def load_model(folder: UPath) -> tuple[pycolmap.Reconstruction, Mapping[int, str]]:
    """Cameras and posed images of the model in `folder`, and the image names by number.

    Raises ValueError for a model that cannot be read, MissingExtraError without pycolmap.
    """
    if find_spec("pycolmap") is None:
        raise MissingExtraError(
            f"reading the COLMAP model {folder} needs pycolmap, which is not installed: run "
            '`pip install "query-gaussians[colmap]"`'
        )
    import pycolmap

    files = files_of(folder)
    assert files is not None
    try:
        with tempfile.TemporaryDirectory() as staged:
            stage = _stage_binary if files == BINARY else _stage_text
            names = stage(folder, Path(staged))
            return pycolmap.Reconstruction(staged), names
    except (ValueError, IndexError, RuntimeError, EOFError) as error:
        raise ValueError(
            f"the COLMAP model {folder} ({', '.join(files)}) cannot be read: {error}; export it "
            "again, or copy it again"
        ) from error


def _stage_text(folder: UPath, staged: Path) -> Mapping[int, str]:
    (staged / "cameras.txt").write_bytes((folder / "cameras.txt").read_bytes())
    (staged / "points3D.txt").write_text("")
    names: dict[int, str] = {}
    with (
        (folder / "images.txt").open("r", encoding="utf-8") as source,
        (staged / "images.txt").open("w", encoding="utf-8") as target,
    ):
        for line in _image_lines(source):
            fields = line.split(maxsplit=9)
            if len(fields) != 10 or not fields[0].isdecimal():
                raise ValueError(
                    f"images.txt has the line {line[:60]!r} where an image was expected: 9 numbers "
                    "and a name, then a line of points, which may be empty"
                )
            names[int(fields[0])] = fields[9]
            target.write(f"{' '.join(fields[:9])} {fields[0]}\n\n")
    return names


def _image_lines(lines: IO[str]) -> Iterator[str]:
    """The lines of images; each is followed by one of points."""
    for line in map(str.strip, lines):
        if line and not line.startswith("#"):
            yield line
            next(lines, None)


def _stage_binary(folder: UPath, staged: Path) -> Mapping[int, str]:
    with (folder / "cameras.bin").open("rb") as source:
        (staged / "cameras.bin").write_bytes(_whole_cameras(source))
    (staged / "points3D.bin").write_bytes(struct.pack("<Q", 0))
    names: dict[int, str] = {}
    with (
        (folder / "images.bin").open("rb") as source,
        (staged / "images.bin").open("wb") as target,
    ):
        end = source.seek(0, 2)
        source.seek(0)
        count = _read(source, "images.bin", 8)
        target.write(count)
        for _ in range(_unsigned(count)):
            header = _read(source, "images.bin", 64)
            number = struct.unpack_from("<I", header)[0]
            names[number] = _name(source)
            target.write(header + str(number).encode() + b"\0" + struct.pack("<Q", 0))
            _skip(source, _unsigned(_read(source, "images.bin", 8)) * _POINTS_OF_AN_IMAGE, end)
    return names


def _whole_cameras(source: IO[bytes]) -> bytes:
    """The content of cameras.bin, which is as long as its cameras say."""
    import pycolmap

    read = [_read(source, "cameras.bin", 8)]
    for _ in range(_unsigned(read[0])):
        header = _read(source, "cameras.bin", 24)
        model = pycolmap.CameraModelId(struct.unpack_from("<i", header, 4)[0])
        camera = pycolmap.Camera.create_from_model_id(1, model, 1.0, 1, 1)
        read += [header, _read(source, "cameras.bin", 8 * len(camera.params))]
    return b"".join(read)


def _read(source: IO[bytes], file: str, count: int) -> bytes:
    content = source.read(count)
    if len(content) < count:
        raise ValueError(f"{file} is truncated")
    return content


def _name(source: IO[bytes]) -> str:
    name = bytearray()
    while (character := _read(source, "images.bin", 1)) != b"\0":
        name += character
        if len(name) > _LONGEST_NAME:
            raise ValueError("images.bin has an endless name")
    return name.decode("utf-8")


def _skip(source: IO[bytes], count: int, end: int) -> None:
    if source.tell() + count > end:
        raise ValueError("images.bin is truncated")
    source.seek(count, 1)


def _unsigned(content: bytes) -> int:
    return struct.unpack("<Q", content)[0]
