"""Small data sets in every format, each with one hostile change that dice choose."""

import importlib
import io
import json
import os
import random
import shutil
import struct
import sys
import zipfile
import zlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from attack import JUNK, other_bytes, other_leaf, other_place

sys.path.append(str(Path(__file__).parents[1] / "tests"))
formats: Any = importlib.import_module("photo_formats")
Image: Any = formats.Image

_SIZE = (30, 40)
_DEEP = 100_000
_PRESS = zlib.compressobj(9, zlib.DEFLATED, -15)
_BOMB = (_PRESS.compress(bytes(10**6)) + _PRESS.flush(zlib.Z_FULL_FLUSH)) * 4000 + _PRESS.flush()
"""4 GB of zeros."""


def write_data_set(folder: Path, chance: random.Random) -> str:
    """Write a data set to `folder`; its format and change in words."""
    kind = chance.choice(sorted(_WRITERS))
    write, listings, own = _WRITERS[kind]
    content = write(folder, chance)
    changes: list[Callable[[], str]] = [
        lambda: _bytes(chance.choice([folder / name for name in listings]), chance),
        lambda: _image(folder, chance),
        *(lambda change=change: change(folder, content, chance) for change in own),
    ]
    chosen = chance.choices([*changes[:2], *changes[2:] * 2], k=chance.choice([1, 1, 1, 2]))
    said = [kind]
    try:
        for change in chosen:
            said.append(change())
        return ": ".join(said)
    except Exception as error:  # what cannot be written either, or is no more there
        return f"{': '.join(said)}: no change ({error})"


def _photos(folder: Path, chance: random.Random, suffix: str = "") -> Any:
    suffix = suffix or chance.choice(["png", "png", "jpg"])
    place = folder.parent / f"{folder.name}-photos"
    photos = formats.synthetic(place, 5, _SIZE, suffix, chance.randrange(1000))
    return formats.centred(photos)


def _nerfstudio(folder: Path, chance: random.Random) -> Any:
    formats.write_nerfstudio(folder, _photos(folder, chance))
    file = folder / "transforms.json"
    data = json.loads(file.read_text())
    if chance.random() < 0.5:
        for place, frame in enumerate(data["frames"]):
            frame.update(mask_path=f"mask{place}.png", depth_file_path=f"depth{place}.npy")
            mask = np.full(_SIZE, 255, np.uint8)
            (folder / frame["mask_path"]).write_bytes(formats.encoded(mask))
            np.save(folder / frame["depth_file_path"], np.ones(_SIZE, np.float32))
        file.write_text(json.dumps(data))
    return None


def _cameras(folder: Path, chance: random.Random) -> Any:
    photos = _photos(folder, chance)
    formats.copied(photos, folder)
    frames = [
        {"image": file.name, "c2w": pose.tolist(), "K": list(photos.intrinsics)}
        for file, pose in zip(photos.files, photos.c2w, strict=True)
    ]
    (folder / "cameras.json").write_text(json.dumps({"w": 40, "h": 30, "frames": frames}))


def _dl3dv(folder: Path, chance: random.Random) -> Any:
    inner = folder / "inner"
    _nerfstudio(inner, chance)
    return inner


def _zipped(folder: Path, inner: Path, chance: random.Random) -> str:
    """Pack the scene, changed before or after."""
    what = chance.choice([_json, lambda *given: _image(given[0], given[2]), None])
    said = what(inner, None, chance) if what else ""
    for file in inner.rglob("*"):
        if not file.is_file():  # what no archive holds
            file.unlink() if not file.is_dir() else None
    archive = folder / f"{'0123456789abcdef' * 4}.zip"
    shutil.make_archive(str(archive.with_suffix("")), "zip", inner)
    shutil.rmtree(inner)
    if what is None:
        with zipfile.ZipFile(archive, "a") as opened:
            name = chance.choice(["../out", "/etc/out", "a/transforms.json/b", "transforms.json"])
            name = chance.choice([name, "images/view_001.png", "\x1b[2J", "a" * 5000])
            member = zipfile.ZipInfo(name)
            opened.writestr(member, _BOMB if (large := chance.random() < 0.3) else b"x")
            if large:  # what the directory at the end says is believed
                member.compress_type, member.file_size = zipfile.ZIP_DEFLATED, 4 * 10**9
            said = f"holds {name[:40]!r}{' of 4 GB' * large}"
        if chance.random() < 0.5:
            said = _bytes(archive, chance)
    return said


def _chunks(folder: Path, chance: random.Random) -> Any:
    photos = _photos(folder, chance)
    w2c = np.linalg.inv(photos.c2w)[:, :3].reshape(-1, 12)
    fx, fy, cx, cy = photos.intrinsics
    rows = [[fx / 40, fy / 30, cx / 40, cy / 30, 0, 0, *row] for row in w2c]
    data = [torch.frombuffer(bytearray(f.read_bytes()), dtype=torch.uint8) for f in photos.files]
    mask = formats.encoded(np.full(_SIZE, 255, np.uint8))
    record = {
        "key": "s0", "url": "", "timestamps": torch.arange(5),
        "cameras": torch.tensor(rows).float(), "images": data, "sizes": torch.tensor([_SIZE] * 5),
        "masks": [torch.frombuffer(bytearray(mask), dtype=torch.uint8)] * 5,
        "held_out": torch.tensor([2]), "names": list("abcde"),
    }  # fmt: skip
    record.pop(chance.choice(["masks", "sizes", "held_out", "names", "url"]))
    (folder / "train").mkdir(parents=True)
    torch.save([record], folder / "train" / "0.torch")
    (folder / "train" / "index.json").write_text('{"s0": "0.torch"}')
    return record


class _Payload:
    def __reduce__(self) -> tuple[Any, ...]:
        return os.system, ("touch qgs-fuzz-ran",)


def _record(folder: Path, record: dict[str, Any], chance: random.Random) -> str:
    """Replace a field of the record, or the record."""
    tensors: list[Callable[[torch.Tensor], Any]] = [
        lambda t: t.to_sparse(), lambda t: t.double().requires_grad_(), lambda t: t[:0],
        lambda t: t.float() * torch.nan, lambda t: t.to(torch.complex64), lambda t: t.bool(),
        lambda t: torch.zeros(1, dtype=t.dtype).expand(10**12), lambda t: t.to("meta"),
        lambda t: t.float() * 1e30, lambda t: t.tolist(), lambda t: t[None],
        lambda t: torch.quantize_per_tensor(t.float(), 0.1, 0, torch.quint8), lambda t: t * 0,
    ]  # fmt: skip
    key = chance.choice(list(record))
    value = record[key]
    change = chance.choice(tensors)
    if isinstance(value, torch.Tensor) and chance.random() < 0.6:
        record[key] = change(value)
    elif isinstance(value, list) and isinstance(value[0], torch.Tensor) and chance.random() < 0.6:
        place = chance.randrange(len(value))
        record[key] = [change(item) if i == place else item for i, item in enumerate(value)]
    else:
        record[key] = chance.choice([*JUNK, torch.tensor(1), torch.tensor([2**62]), [3] * 5])
    records: Any = [record]
    twist = chance.randrange(12)
    if twist == 0:
        records.append(records)
    elif twist == 1:
        records = [{**record, "url": _Payload()}]
    elif twist == 2:
        records = chance.choice([[], {}, [None], [[]], [record, record], 7, [{"key": 3}]])
    elif twist == 3:
        one = {name: item[:1] for name, item in record.items() if hasattr(item, "__getitem__")}
        records = [{**one, "key": "s0"}]
    torch.save(records, folder / "train" / "0.torch")
    return f"{key} is {str(record[key])[:40]!r}, twist {twist}"


def _json(folder: Path, _: Any, chance: random.Random) -> str:
    """Replace or remove a value of a JSON file, or nest it deeply."""
    file = chance.choice(sorted(folder.rglob("*.json")))
    whole = file.read_text()
    if chance.random() < 0.15:
        told, data = chance.choice([
            ("deep", ("[" * _DEEP + "]" * _DEEP).encode()), ("twice", (whole * 2).encode()),
            ("UTF-16", whole.encode("utf-16")), ("with a mark", whole.encode("utf-8-sig")),
            ("a number", b"7"), ("a list", b"[]"), ("another's key", b'{"frames": {"a": [1]}}'),
            ("keys twice", (whole[0] + whole[1:-1] + ", " + whole[1:]).encode()),
            ("no UTF-8", whole.encode() + b'\xff'), ("100 MB of spaces", b" " * 10**8),
        ])  # fmt: skip
        file.write_bytes(data)
        return f"{file.name} is {told}"
    data = json.loads(whole)
    said = other_leaf(data, chance)
    file.write_text(json.dumps(data))
    return f"{file.name} {said}"


def _array(folder: Path, _: Any, chance: random.Random) -> str:
    """Change an .npy file."""
    found = sorted(folder.rglob("*.npy"))
    if not found:
        return _image(folder, chance)
    file = chance.choice(found)
    values = np.load(file)
    what = chance.choice(
        ["objects", "header", "shape", "NaN", "1e308", "integers", "words", "half"]
    )
    out = io.BytesIO()
    if what == "objects":
        np.save(out, np.array([[{}] * 17] * 5, object), allow_pickle=True)
    elif what == "header":
        shape = chance.choice([(10**12, 17), (2**62, 4), (-1, 17), (10**9,), (5, 17, 10**9), ()])
        header = {"descr": chance.choice(["<f8", "|O"]), "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(out, header)
    elif what == "half":
        out.write(file.read_bytes()[: file.stat().st_size // 2])
    else:
        place = tuple(chance.randrange(extent) for extent in values.shape)
        if what in ("NaN", "1e308"):
            values = values.astype(np.float64)
            values[place] = float(what)
        kinds = {"integers": np.int64, "words": str}
        values = values.astype(kinds[what]) if what in kinds else values
        np.save(out, values[:-1] if what == "shape" else values)
    file.write_bytes(out.getvalue())
    return f"{file.name}: {what}"


def _text(folder: Path, _: Any, chance: random.Random) -> str:
    """Replace a word of a COLMAP text file."""
    found = sorted(folder.rglob("*.txt"))
    if not found:
        return _bytes(chance.choice(sorted(folder.rglob("*.bin"))), chance)
    file = chance.choice(found)
    words = file.read_text().split(" ")
    place, value = chance.randrange(len(words)), chance.choice(JUNK[:21])
    words[place] = str(value)
    file.write_text(" ".join(words), errors="replace")
    return f"{file.name}, word {place} is {words[place][:30]!r}"


def _bytes(file: Path, chance: random.Random) -> str:
    return f"{file.name}: {other_bytes(file, chance)}"


def _image(folder: Path, chance: random.Random) -> str:
    """Damage or replace a photo, a mask or a depth map."""
    kinds_of_file = (".png", ".jpg", ".npy")
    found = [f for f in sorted(folder.rglob("*")) if f.suffix in kinds_of_file and f.is_file()]
    if not found:
        return "no change: its photos are inside of another file"
    file = chance.choice(found)
    shades, exif = [*map(_grey, range(200))], Image.Exif()
    exif[0x0112] = 6
    kinds: dict[str, Callable[[], bytes]] = {
        "bomb": lambda: _png(30_000, 30_000),
        "large": lambda: _png(4_000, 3_000),
        "swapped": lambda: _png(30, 40),
        "no pixels": lambda: _png(0, 0),
        "float": lambda: formats.encoded(Image.fromarray(np.ones(_SIZE, np.float32)), "TIFF"),
        "PostScript": lambda: formats.encoded(np.zeros((*_SIZE, 3), np.uint8), "EPS"),
        "48 megapixels": _of_48_megapixels,
        "turned": lambda: formats.encoded(_grey(), "JPEG", exif=exif),
        "16 bits": lambda: formats.encoded(np.full(_SIZE, 40_000, np.uint16)),
        "text bomb": lambda: _png(40, 30, b"zTXt", b"a\0\0" + zlib.compress(b" " * 10**8)),
        "profile": lambda: _png(40, 30, b"iCCP", b"a\0\0" + zlib.compress(b"\xff" * 10**6)),
        "many frames": lambda: formats.encoded(_grey(), "GIF", save_all=True, append_images=shades),
        "many pages": lambda: formats.encoded(_grey(), "TIFF", save_all=True, append_images=shades),
        "web page": lambda: b"<!DOCTYPE html><title>404</title>" * 9,
    }
    kind = chance.choice([*kinds, "bytes", "bytes", "place"])
    if kind == "bytes":
        return _bytes(file, chance)
    if kind == "place":
        return f"{file.name} {other_place(file, chance)}"
    file.write_bytes(kinds[kind]())
    return f"{file.name} is {kind}"


def _grey(shade: int = 128) -> Any:
    return Image.new("L", _SIZE[::-1], shade)


@cache
def _of_48_megapixels() -> bytes:
    """A photo of a phone, with noise, of the same shape as the others."""
    noise = np.random.default_rng(0).integers(0, 256, (1000, 1000, 3), np.uint8)
    return formats.encoded(Image.fromarray(np.tile(noise, (6, 8, 1))), "JPEG")


def _png(width: int, height: int, kind: bytes = b"", data: bytes = b"") -> bytes:
    """A black 1-bit PNG. kind, data: of one more chunk."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    rows = zlib.compress(bytes((1 + (width + 7) // 8) * height), 1)
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0))
    more = chunk(kind, data) if kind else b""
    return b"\x89PNG\r\n\x1a\n" + header + more + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def _of_format(write: Callable[..., Any], *options: Any) -> Callable[..., Any]:
    return lambda folder, chance: write(folder, _photos(folder, chance), *options)


_WRITERS: dict[str, tuple[Callable[..., Any], tuple[str, ...], tuple[Callable[..., str], ...]]] = {
    "nerfstudio": (_nerfstudio, ("transforms.json",), (_json, _json, _array)),
    "blender": (_of_format(formats.write_blender, 3), ("transforms_train.json",), (_json,)),
    "cameras": (_cameras, ("cameras.json",), (_json,)),
    "llff": (_of_format(formats.write_llff), ("poses_bounds.npy",), (_array,)),
    **{
        f"colmap {kind}": (
            _of_format(formats.write_colmap, kind),
            (f"sparse/0/cameras.{suffix}", f"sparse/0/images.{suffix}"),
            (_text,),
        )
        for kind, suffix in (("text", "txt"), ("binary", "bin"))
    },
    "dl3dv": (_dl3dv, ("inner/transforms.json",), (_zipped,)),
    "chunks": (_chunks, ("train/index.json", "train/0.torch"), (_record, _record, _record, _json)),
}
