"""Fuzz cases of data: small data sets of every format, in which one file is damaged.

Each data set is checked as by `qgs data check`, and read as by training. Reading must succeed, or
fail with an error that names the data set. If reading fails, the check must report an error.
"""

import json
import logging
import random
import shutil
from collections.abc import Callable
from functools import partial
from importlib import import_module
from pathlib import Path
from random import choice, randrange
from typing import Any

import numpy as np
import torch
from qgs_photos.datatools.candidates import sources
from qgs_photos.datatools.check import Options, check
from qgs_photos.datatools.packing import chosen_splits, pack
from upath import UPath

from fuzzing.cases import JUNK, FaultError, Use, other_bytes, other_leaf, refused
from qgs.contracts import SceneSource, ViewsConfig
from qgs.data.recognition import open_for
from qgs.data.stream import SampleStream
from qgs.paths import opened_path

formats: Any = import_module("photo_formats")
parts: Any = import_module("small_parts")
SIZE = (30, 40)


def opened(folder: Path) -> SceneSource:
    """Open the data set in `folder` as training does."""
    return open_for(str(folder), (16, 16), None, sources())[0]


def write_nerfstudio(folder: Path, photos: Any) -> Path:
    """Write photos to `folder` in nerfstudio's format, with masks and depth maps; return it."""
    formats.write_nerfstudio(folder, photos)
    (folder / "mask.png").write_bytes(formats.encoded(np.full(SIZE, 255, np.uint8)))
    np.save(folder / "depth.npy", np.ones(SIZE, np.float32))
    listing = folder / "transforms.json"
    more = '"mask_path": "mask.png", "depth_file_path": "depth.npy", "file_path"'
    listing.write_text(listing.read_text().replace('"file_path"', more))
    return folder


def write_cameras(folder: Path, photos: Any) -> None:
    """Write photos to `folder` with a custom list of cameras, whose key names are not standard."""
    formats.write_nerfstudio(folder, photos, K=photos.intrinsics)
    listing = folder / "transforms.json"
    text = listing.read_text().replace("transform_matrix", "c2w")
    listing.rename(folder / "cameras.json").write_text(text)


def write_dl3dv(folder: Path, photos: Any) -> None:
    inner = write_nerfstudio(folder.with_name("inner"), photos)
    shutil.make_archive(str(folder / ("0123456789abcdef" * 4)), "zip", inner)


def write_chunks(folder: Path, photos: Any) -> None:
    source = opened(write_nerfstudio(folder.with_name("inner"), photos))
    pack(source, chosen_splits(source), UPath(folder), {})


WRITERS: dict[str, Callable[[Path, Any], object]] = {
    "nerfstudio": write_nerfstudio,
    "blender": partial(formats.write_blender, train=3),
    "cameras": write_cameras,
    "llff": formats.write_llff,
    "colmap text": partial(formats.write_colmap, kind="text"),
    "colmap binary": partial(formats.write_colmap, kind="binary"),
    "dl3dv": write_dl3dv,
    "chunks": write_chunks,
}


def damaged(file: Path) -> str:
    """Damage a file: its values, or its bytes if the format is unknown.

    Returns a description of the damage.
    """
    match file.suffix:
        case ".json":
            tree = json.loads(file.read_text())
            what = other_leaf(tree)
            file.write_text(json.dumps(tree))
        case ".txt":
            words = file.read_text().split(" ")
            what = other_leaf(words)
            file.write_text(" ".join(map(str, words)))
        case ".npy":
            values = np.load(file).astype(np.float64)
            values.flat[randrange(values.size)] = choice((np.nan, np.inf, 1e308, -1.0))
            np.save(file, values[: choice((None, -1))])
            what = "values or their number"
        case ".torch":
            records = torch.load(file)
            what = other_leaf(records, [*JUNK, parts.Code(), torch.tensor([2**62])])
            torch.save(records, file)
        case _:
            what = other_bytes(file)
    return what


def case_in(_: Path, folder: Path) -> tuple[str, Use]:
    """Write a data set to `folder` and damage one of its files.

    Returns a description of the case, and the function that uses it.
    """
    data = folder / "data"
    data.mkdir()
    kind = choice([*WRITERS])
    suffix = choice(["png", "jpg"])
    photos = formats.synthetic(folder / "photos", 5, SIZE, randrange(1000), suffix)
    WRITERS[kind](data, formats.centred(photos))
    found = [file for file in sorted(data.rglob("*")) if file.is_file()]
    listings = [file for file in found if file.suffix not in (".png", ".jpg")]
    file = choice(listings if random.random() < 0.7 else found)
    damage = damaged if random.random() < 0.6 else other_bytes
    return f"{kind}: {file.name}: {damage(file)}", partial(judged, data)


def read(folder: Path) -> None:
    """Read all frames of all scenes, and make a training sample. Raises the errors of reading."""
    source = opened(folder)
    for split in ("train", "test"):
        for scene in source.scenes(split):
            cameras = scene.cameras
            frames = range(len(scene))
            every = [scene.images(frames), scene.masks(frames), scene.depths(frames)]
            for tensor in (cameras.c2w, cameras.intrinsics, *every):
                if tensor is not None and not torch.isfinite(tensor).all():
                    raise FaultError(f"{scene.name} is read with NaN or infinite numbers")
    scenes = source.scenes("train")
    if scenes and all(len(scene) - len(scene.held_out) > 1 for scene in scenes):
        SampleStream(source, ViewsConfig(inputs=2, targets=1, gap=(1, 3)), 0).batch([0])


def judged(folder: Path) -> str:
    """Check and read a data set; return the outcome of both, "refused" or success.

    Raises an error that no user should see.
    """
    try:
        report = check(opened_path(folder), Options(geometry=1, threads=1))
        errors = [str(finding) for finding in report.findings if finding.severity == "error"]
    except (ValueError, OSError) as error:
        refused(error, str(folder))
        errors = [str(error)]
    try:
        read(folder)
    except (ValueError, OSError) as error:
        if not errors:
            raise FaultError(f"the check finds no error, but reading raises: {error}") from error
        return f"{refused(error, str(folder))}: {error}"
    return f"success, with errors of the check: {errors}" if errors else "success"


def prepare(_: Path) -> None:
    """Turn off warnings that damaged files cause."""
    np.seterr(all="ignore")
    logging.disable(logging.CRITICAL)
