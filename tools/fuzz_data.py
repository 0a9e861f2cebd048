"""Damage small data sets of every format, and see that each is read or refused well.

    python tools/fuzz_data.py --count 200 --seed 0
    python tools/fuzz_data.py --seed 0 --only 17

Each case is checked as `qgs data check` does and read as training does; see fuzzing.py. What cannot
be read, the check must call an error.
"""

import importlib
import json
import logging
import random
import shutil
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from fuzzing import JUNK, FaultError, Use, fuzz, other_bytes, other_leaf, refused
from qgs_photos.datatools.check import Options, check
from qgs_photos.datatools.sources import sources

from qgs.contracts import ViewsConfig
from qgs.data.recognition import open_for
from qgs.data.stream import SampleStream
from qgs.paths import opened_path

sys.path.append(str(Path(__file__).parents[1] / "tests"))
formats: Any = importlib.import_module("photo_formats")
SIZE = (30, 40)


def photos_in(folder: Path, dice: random.Random) -> Any:
    place, suffix = folder.parent / "photos", dice.choice(["png", "jpg"])
    return formats.centred(formats.synthetic(place, 5, SIZE, suffix, dice.randrange(1000)))


def write_nerfstudio(folder: Path, photos: Any) -> None:
    """With masks and depth maps."""
    formats.write_nerfstudio(folder, photos)
    file = folder / "transforms.json"
    data = json.loads(file.read_text())
    for number, frame in enumerate(data["frames"]):
        frame.update(mask_path=f"mask{number}.png", depth_file_path=f"depth{number}.npy")
        mask = formats.encoded(np.full(SIZE, 255, np.uint8))
        (folder / frame["mask_path"]).write_bytes(mask)
        np.save(folder / frame["depth_file_path"], np.ones(SIZE, np.float32))
    file.write_text(json.dumps(data))


def write_cameras(folder: Path, photos: Any) -> None:
    formats.copied(photos, folder)
    frames = [
        {"image": file.name, "c2w": pose.tolist(), "K": list(photos.intrinsics)}
        for file, pose in zip(photos.files, photos.c2w, strict=True)
    ]
    (folder / "cameras.json").write_text(json.dumps({"w": 40, "h": 30, "frames": frames}))


def write_dl3dv(folder: Path, photos: Any) -> None:
    write_nerfstudio(folder / "inner", photos)
    name = folder / ("0123456789abcdef" * 4)
    shutil.make_archive(str(name), "zip", folder / "inner")
    shutil.rmtree(folder / "inner")


def write_chunks(folder: Path, photos: Any) -> None:
    fx, fy, cx, cy = photos.intrinsics
    w2c = np.linalg.inv(photos.c2w)[:, :3].reshape(-1, 12)
    rows = [[fx / 40, fy / 30, cx / 40, cy / 30, 0, 0, *row] for row in w2c]
    data = [torch.frombuffer(bytearray(f.read_bytes()), dtype=torch.uint8) for f in photos.files]
    record = {
        "key": "s0", "url": "", "timestamps": torch.arange(5),
        "cameras": torch.tensor(rows).float(), "images": data, "sizes": torch.tensor([SIZE] * 5),
        "held_out": torch.tensor([2]), "names": list("abcde"),
    }  # fmt: skip
    (folder / "train").mkdir(parents=True)
    torch.save([record], folder / "train" / "0.torch")
    (folder / "train" / "index.json").write_text('{"s0": "0.torch"}')


WRITERS: dict[str, Callable[[Path, Any], object]] = {
    "nerfstudio": write_nerfstudio,
    "blender": lambda folder, photos: formats.write_blender(folder, photos, 3),
    "cameras": write_cameras,
    "llff": formats.write_llff,
    "colmap text": lambda folder, photos: formats.write_colmap(folder, photos, "text"),
    "colmap binary": lambda folder, photos: formats.write_colmap(folder, photos, "binary"),
    "dl3dv": write_dl3dv,
    "chunks": write_chunks,
}


class Payload:
    """Code that a pickle would run."""

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (Path("qgs-fuzz-ran"),)


def damage(file: Path, dice: random.Random) -> str:
    """Change what a file says if its format is known, or its bytes; what was done."""
    if dice.random() < 0.4:
        return other_bytes(file, dice)
    if file.suffix == ".json":
        data = json.loads(file.read_text())
        what = other_leaf(data, dice)
        file.write_text(json.dumps(data))
        return what
    if file.suffix == ".txt":
        words = file.read_text().split(" ")
        place = dice.randrange(len(words))
        words[place] = str(dice.choice(JUNK))
        file.write_text(" ".join(words))
        return f"word {place} is {words[place][:30]!r}"
    if file.suffix == ".npy":
        values = np.load(file).astype(np.float64)
        values.flat[dice.randrange(values.size)] = dice.choice((np.nan, np.inf, 1e308, -1.0))
        np.save(file, values[: dice.choice((None, -1))])
        return f"values of {values.shape}"
    if file.suffix == ".torch":
        (record,) = torch.load(file)
        key = dice.choice(list(record))
        value = record[key]
        changed = [dice.choice(JUNK), Payload(), [value], torch.tensor([2**62])]
        if isinstance(value, torch.Tensor):
            changed += [value[:-1], value.float() * torch.nan, value.float() * 1e30, value.tolist()]
        record[key] = dice.choice(changed)
        torch.save([record], file)
        return f"{key} is {str(record[key])[:40]!r}"
    return other_bytes(file, dice)


def write_data_set(folder: Path, dice: random.Random) -> str:
    """Write a data set with one damaged file; its format and the damage."""
    kind = dice.choice(sorted(WRITERS))
    folder.mkdir()
    WRITERS[kind](folder, photos_in(folder, dice))
    photo = {".png", ".jpg"}
    found = [file for file in sorted(folder.rglob("*")) if file.is_file()]
    listings = [file for file in found if file.suffix not in photo]
    file = dice.choice(listings if dice.random() < 0.7 else found)
    return f"{kind}: {file.name}: {damage(file, dice)}"


def read(folder: str) -> None:
    """Read all frames of all scenes, and draw a sample. Raises what reading raises."""
    source, _ = open_for(folder, (16, 16), None, sources())
    for split in ("train", "test"):
        for scene in source.scenes(split):
            cameras, frames = scene.cameras, range(len(scene))
            every = [scene.images(frames), scene.masks(frames), scene.depths(frames)]
            for tensor in (cameras.c2w, cameras.intrinsics, *every):
                if tensor is not None and not torch.isfinite(tensor).all():
                    raise FaultError(f"{scene.name} is delivered with NaN or infinite numbers")
    scenes = source.scenes("train")
    if all(len(scene) - len(scene.held_out) > 1 for scene in scenes) and len(scenes):
        SampleStream(source, ViewsConfig(inputs=2, targets=1, gap=(1, 3)), 0).batch([0])


def judged(folder: Path) -> str:
    """How checking and reading end. Raises what a user must not see."""
    try:
        report = check(opened_path(folder), Options(geometry=1, threads=1))
        errors = [str(finding) for finding in report.findings if finding.severity == "error"]
    except (ValueError, OSError) as error:
        refused(error, str(folder))
        errors = [str(error)]
    try:
        read(str(folder))
    except (ValueError, OSError) as error:
        end = refused(error, str(folder))
        if not errors:
            raise FaultError(f"the check finds nothing, reading raises: {error}") from error
        return f"{end}: {error}"
    if Path("qgs-fuzz-ran").exists():
        raise FaultError("code of a pickle ran")
    return "success" if not errors else f"success, with errors of the check: {errors}"


def prepared(_: Path) -> Callable[[random.Random, Path], tuple[str, Use]]:
    """Cases have nothing in common."""
    np.seterr(all="ignore")
    logging.disable(logging.CRITICAL)

    def case_in(dice: random.Random, folder: Path) -> tuple[str, Use]:
        return write_data_set(folder / "data", dice), partial(judged, folder / "data")

    return case_in


if __name__ == "__main__":
    sys.exit(fuzz(__doc__, prepared))
