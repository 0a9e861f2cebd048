"""Errors of the poses that `qgs poses` finds for few photos, drawn from folders with known poses.

    python tools/pose_errors.py PHOTOS ... [--photos 2 3 4 8] [--draws 50] [--seed 0]

Each draw is a photo and others that share half of what it shows, at most 35 degrees apart from it.
The error of two photos is the larger of the angles between found and true relative rotation, and
direction of translation; 180 degrees without poses. AUC@t is the mean of 1 - error / t, at least 0.
EXIF of the copies gives the focal length ("known") or nothing. Of more than two photos, errors are
those of all pairs.
"""

import argparse
from collections import defaultdict
from collections.abc import Sequence
from itertools import combinations, product
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from PIL import Image
from qgs_photos.poses.making import Options, make_poses
from qgs_photos.poses.photos import PosesError
from rich.console import Console
from upath import UPath

from qgs.contracts import Scene
from qgs.data.inputs import Frusta
from qgs.data.photos import read_listing
from qgs.data.photos.reader import PhotoFrame
from qgs.domain import Domain
from qgs.reconstruction.scenes import photo_scene

ANGLES = (10, 20, 35)
THRESHOLDS = (5, 10, 20)
SEEN = 0.3
APART = 0.02


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--photos", nargs="+", type=int, default=[2])
    parser.add_argument("--draws", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    for count, known in product(options.photos, (True, False)):
        rows = defaultdict[str, list[np.ndarray]](list)
        for folder in options.folders:
            scene = photo_scene(str(folder), None, None)
            frames = read_listing(UPath(folder)).frames
            for group in drawn(scene, count, options.draws, options.seed):
                found, angle = errors([frames[place] for place in group], known)
                bound = next(bound for bound in ANGLES if angle <= bound)
                for name in ("all", folder.name, f"up to {bound} degrees"):
                    rows[name].append(found)
        for name, groups in rows.items():
            report(f"{count} photos, focal {'known' if known else 'unknown'}, {name}", groups)


def drawn(scene: Scene, count: int, draws: int, seed: int) -> list[list[int]]:
    """Return groups of `count` photos, as indices of frames, by the seed."""
    rng = np.random.default_rng(seed)
    frusta = Frusta(scene, Domain())
    seen = np.stack([frusta.seen(one, range(len(scene))).mean(0) for one in range(len(scene))])
    turns = turned(*(scene.cameras.c2w[:, :3, :3].double().numpy(),) * 2)
    fits = (turns <= ANGLES[-1]) & (np.minimum(seen, seen.T) >= SEEN) & (frusta.apart >= APART)
    firsts = np.nonzero(fits.sum(1) >= count - 1)[0]
    groups = list[list[int]]()
    for first in rng.choice(firsts, draws):
        others = rng.choice(np.nonzero(fits[first])[0], count - 1, replace=False)
        groups.append([int(first), *map(int, others)])
    return groups


def turned(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the angles (A, B) in degrees between rotations (A, 3, 3) and (B, 3, 3)."""
    cosine = (np.einsum("aij,bij->ab", one, other) - 1) / 2
    return np.degrees(np.arccos(cosine.clip(-1, 1)))


def errors(photos: Sequence[PhotoFrame], known: bool) -> tuple[np.ndarray, float]:
    """Return the errors of all pairs of photos, and the largest angle to the first photo."""
    true = np.stack([photo.c2w for photo in photos])
    angle = turned(true[:1, :3, :3], true[1:, :3, :3]).max()
    with TemporaryDirectory() as temporary:
        folder = Path(temporary, "photos")
        folder.mkdir()
        for place, photo in enumerate(photos):
            image = Image.open(str(photo.path)).convert("RGB")
            exif = Image.Exif()
            if known:
                # of film with a diagonal of 43.27 mm
                focal = photo.intrinsics[0] / np.hypot(*photo.size) * 43.27
                exif.get_ifd(0x8769)[0xA405] = round(focal)
            image.save(folder / f"{place}.jpg", exif=exif, quality=100, subsampling=0)
        try:
            make_poses(folder, Path(temporary, "out"), Options(threads=1), Console(quiet=True))
        except PosesError:
            found = {}
        else:
            listed = read_listing(UPath(temporary, "out")).frames
            found = {int(UPath(frame.path).stem): frame.c2w for frame in listed}
    all_pairs = combinations(range(len(photos)), 2)
    return np.array(
        [error(true[[*pair]], [found.get(i) for i in pair]) for pair in all_pairs]
    ), angle


def error(true: np.ndarray, found: list[np.ndarray | None]) -> float:
    if any(pose is None for pose in found):
        return np.inf
    one, other = (np.linalg.inv(poses[1]) @ poses[0] for poses in (true, np.stack(found)))
    directions = [pose[:3, 3] / np.linalg.norm(pose[:3, 3]) for pose in (one, other)]
    direction = np.degrees(np.arccos(np.clip(directions[0] @ directions[1], -1, 1)))
    return max(turned(one[None, :3, :3], other[None, :3, :3]).item(), direction)


def report(name: str, groups: list[np.ndarray]) -> None:
    """Print AUC, the share of pairs with poses, and the share of these with errors above 20."""
    all_of_them = np.concatenate(groups)
    accepted = all_of_them[np.isfinite(all_of_them)]
    scores = [f"{np.clip(1 - all_of_them / bound, 0, 1).mean():.3f}" for bound in THRESHOLDS]
    wrong = (accepted > THRESHOLDS[-1]).mean() if accepted.size else 0
    print(
        f"{name} ({len(groups)}): AUC {' / '.join(scores)}, with poses {accepted.size / all_of_them.size:.0%}, "
        f"of these wrong {wrong:.0%}",
        flush=True,
    )


if __name__ == "__main__":
    main()
