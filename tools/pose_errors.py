"""Errors of the poses that `qgs poses` finds for few photos, drawn from a folder with known poses.

    python tools/pose_errors.py PHOTOS [COUNT] [DRAWS] [known]

Each of DRAWS groups (default 50) is a photo and COUNT - 1 others (default 1) that show a third of
the same, at most 35 degrees apart from it. The error of two photos of a group is the larger of the
angles between found and true rotation, and direction of translation; infinite without poses. AUC@t
is the mean of 1 - error / t, at least 0. Rows are by the largest angle to the first photo. known:
EXIF of the photos gives the focal length.
"""

import sys
from collections import defaultdict
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image
from qgs_photos.poses.making import Options, make_poses
from qgs_photos.poses.photos import PosesError
from rich.console import Console
from upath import UPath

from qgs.data.inputs import Frusta
from qgs.data.photos import read_listing
from qgs.domain import Domain
from qgs.reconstruction.scenes import photo_scene

Array = npt.NDArray[Any]

ANGLES = (10, 20, 35)
THRESHOLDS = (5, 10, 20)
# Least share of a photo that another sees, and least distance relative to the depth.
SEEN = 0.3
APART = 0.02


def main(folder: str, count: str = "2", draws: str = "50", known: str = "") -> None:
    rng = np.random.default_rng(0)
    photos = read_listing(UPath(folder)).frames
    frusta = Frusta(photo_scene(folder, None, None), Domain())
    seen = np.stack([frusta.seen(one, range(len(photos))).mean(0) for one in range(len(photos))])
    c2w = np.stack([photo.c2w for photo in photos])
    angles = turns(c2w[:, None], c2w)
    fits = (angles <= ANGLES[-1]) & (np.minimum(seen, seen.T) >= SEEN) & (frusta.apart >= APART)
    others = int(count) - 1
    rows = defaultdict[str, list[Array]](list)
    for first in rng.choice(np.nonzero(fits.sum(1) >= others)[0], int(draws)):
        group = [first, *rng.choice(np.nonzero(fits[first])[0], others, replace=False)]
        found = errors([photos[place] for place in group], known)
        bound = ANGLES[np.searchsorted(ANGLES, angles[first, group].max())]
        for name in ("all", f"up to {bound} degrees"):
            rows[name].append(found)
    for name, groups in rows.items():
        found = np.concatenate(groups)
        scores = [f"{np.clip(1 - found / bound, 0, 1).mean():.3f}" for bound in THRESHOLDS]
        posed = found[np.isfinite(found)]
        wrong = (posed > THRESHOLDS[-1]).mean()
        share = len(posed) / len(found)
        print(f"{name} ({len(groups)}): AUC {scores}, with poses {share:.0%}, wrong {wrong:.0%}")


def degrees(cosines: Array) -> Array:
    return np.degrees(np.arccos(cosines.clip(-1, 1)))


def turns(one: Array, other: Array) -> Array:
    """Return the angles between the rotations of poses (..., 4, 4)."""
    products = one[..., :3, :3] * other[..., :3, :3]
    return degrees((products.sum((-1, -2)) - 1) / 2)


def errors(photos: Sequence[Any], known: str) -> Array:
    """Return the errors (P,) of all pairs of `photos`, as a listing has them."""
    true = np.stack([photo.c2w for photo in photos])
    found = np.full_like(true, np.nan)
    with TemporaryDirectory() as temporary, suppress(PosesError):
        folder = Path(temporary, "photos")
        folder.mkdir()
        for place, photo in enumerate(photos):
            exif = Image.Exif()
            if known:
                # of film with a diagonal of 43.27 mm
                focal = photo.intrinsics[0] / np.hypot(*photo.size) * 43.27
                exif.get_ifd(0x8769)[0xA405] = round(focal)
            image = Image.open(str(photo.path)).convert("RGB")
            image.save(folder / f"{place}.jpg", exif=exif, quality=100)
        out = Path(temporary, "out")
        make_poses(folder, out, Options(threads=1), Console(quiet=True))
        for frame in read_listing(UPath(out)).frames:
            found[int(UPath(frame.path).stem)] = frame.c2w
    pairs = np.triu_indices(len(photos), 1)
    one, other = ((np.linalg.inv(poses)[:, None] @ poses)[pairs] for poses in (true, found))
    directions = (
        pose[:, :3, 3] / np.linalg.norm(pose[:, :3, 3], axis=1)[:, None] for pose in (one, other)
    )
    cosines = np.prod([*directions], 0).sum(1)
    return np.nan_to_num(np.maximum(turns(one, other), degrees(cosines)), nan=np.inf)


if __name__ == "__main__":
    main(*sys.argv[1:])
