"""Errors of the poses that `qgs poses` finds for few photos, drawn from a folder with known poses.

    python tools/pose_errors.py PHOTOS [COUNT] [DRAWS] [known]

Each of DRAWS groups (default 50) is a photo and COUNT - 1 others (default 1) that show a third of
the same, with axes at most 35 degrees apart from its axis. The error of two photos of a group is
the larger of the angles between found and true rotation, and direction of translation; infinite
without poses. AUC@t is the mean of 1 - error / t, at least 0. Rows are by the largest angle to the
first photo. known: EXIF of the photos gives the focal length.
"""

import sys
from collections import defaultdict
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from PIL import Image
from qgs_photos.poses.making import Options, make_poses
from qgs_photos.poses.photos import PosesError
from rich.console import Console
from upath import UPath

from qgs.data.inputs import Frusta
from qgs.data.photos import read_listing
from qgs.domain import Domain
from qgs.reconstruction.scenes import photo_scene

ANGLES = (10, 20, 35)
# Least share of a photo that another sees, and least distance relative to the depth.
SEEN = 0.3
APART = 0.02


def main(folder: str, count: str = "2", draws: str = "50", known: str = "") -> None:
    rng = np.random.default_rng(0)
    photos = read_listing(UPath(folder)).frames
    frusta = Frusta(photo_scene(folder, None, None), Domain())
    places = range(len(photos))
    seen = np.stack([frusta.seen(place, places).mean(0) for place in places]) >= SEEN
    fits = (frusta.turns <= ANGLES[-1]) & (frusta.apart >= APART) & seen & seen.T
    others = int(count) - 1
    rows = defaultdict[str, list[float]](list)
    for first in rng.choice(np.nonzero(fits.sum(1) >= others)[0], int(draws)):
        group = [first, *rng.choice(np.nonzero(fits[first])[0], others, replace=False)]
        found = errors([photos[place] for place in group], known)
        bound = ANGLES[np.searchsorted(ANGLES, frusta.turns[first, group].max())]
        rows["all"] += found
        rows[f"up to {bound} degrees"] += found
    for name, found in rows.items():
        parts = np.clip(1 - np.divide.outer(found, (5, 10, 20)), 0, 1)
        posed = [x for x in found if x < np.inf]
        wrong = sum(x > 20 for x in posed)
        auc = parts.mean(0).round(3)
        print(f"{name}: AUC {auc}, {len(posed)} of {len(found)} posed, of these {wrong} wrong")


def errors(photos: Sequence[Any], known: str) -> list[float]:
    """Return the errors of all pairs of `photos`, which are frames of a listing."""
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
    # of each row of [rotation | translation]
    products = one[:, :3] * other[:, :3]
    lengths = np.linalg.norm(one[:, :3, 3], axis=1) * np.linalg.norm(other[:, :3, 3], axis=1)
    turn = (products[..., :3].sum((1, 2)) - 1) / 2
    cosines = np.minimum(turn, products[..., 3].sum(1) / lengths).clip(-1, 1)
    return np.nan_to_num(np.degrees(np.arccos(cosines)), nan=np.inf).tolist()


if __name__ == "__main__":
    main(*sys.argv[1:])
