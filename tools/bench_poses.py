"""How well `qgs poses` finds cameras that are known: registered photos, errors, time of each stage.

    python tools/bench_poses.py FOLDER ... --out NEW_FOLDER [--video FPS] [--every N]

FOLDER: photos with cameras in any format; the photos alone are given to `qgs poses`, or with
--video an mp4 (H.264) of them. Errors are after a similarity, whose rotation aligns the
orientations best and whose scale and translation the centres; positions in parts of the extent:
the largest distance of two cameras.
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image
from qgs_photos.poses.film import write_film
from qgs_photos.poses.making import Options, make_poses
from rich.console import Console

from qgs.data.photos import read_listing
from qgs.paths import opened_path


def aligned(found: np.ndarray, true: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Degrees and distances, (N,) each, of poses (N, 4, 4) to true ones; see above."""
    u, _, v = np.linalg.svd(np.einsum("nij,nkj->ik", true[:, :3, :3], found[:, :3, :3]))
    turn = u @ np.diag([1, 1, np.linalg.det(u @ v)]) @ v
    a, b = found[:, :3, 3] @ turn.T, true[:, :3, 3]
    a0, b0 = a - a.mean(0), b - b.mean(0)
    distances = np.linalg.norm((a0 * b0).sum() / (a0**2).sum() * a0 - b0, axis=-1)
    extent = np.linalg.norm(b[:, None] - b[None], axis=-1).max()
    between = np.einsum("ij,njk,nlk->nil", turn, found[:, :3, :3], true[:, :3, :3])
    cosine = ((np.trace(between, axis1=1, axis2=2) - 1) / 2).clip(-1, 1)
    return np.degrees(np.arccos(cosine)), distances / extent


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--video", type=int, help="frames per second")
    parser.add_argument("--every", type=int, default=1, help="take every n-th photo")
    parser.add_argument("--frames", type=int, help="of the video")
    arguments = parser.parse_args()
    for folder in arguments.folders:
        listing = read_listing(opened_path(folder)).frames[:: arguments.every]
        photos = arguments.out / folder.name
        photos.mkdir(parents=True)
        files = [Path(str(frame.path)) for frame in listing]
        source = photos
        if arguments.video:
            source = photos / "video.mp4"
            pictures = (np.array(Image.open(file).convert("RGB")) for file in files)
            write_film(pictures, source, arguments.video)
        else:
            for file in files:
                (photos / file.name).symlink_to(file.resolve())
        made = make_poses(
            source, photos / "poses", Options(frames=arguments.frames), Console(stderr=True)
        )
        found = read_listing(opened_path(made.folder)).frames
        if arguments.video:
            truth = _of_frames(made.folder, found, listing, files)
        else:
            known = {Path(frame.name).name: frame.c2w for frame in listing}
            truth = [known[Path(frame.name).name] for frame in found]
        turn, distance = aligned(np.stack([f.c2w for f in found]), np.stack(truth))
        print(
            json.dumps(
                {
                    "scene": folder.name,
                    "posed": len(made.posed),
                    "of": len(made.posed) + len(made.without),
                    "degrees": [round(float(np.median(turn)), 3), round(float(turn.max()), 3)],
                    "of extent": [
                        round(float(np.median(distance)), 5),
                        round(float(distance.max()), 5),
                    ],
                    "seconds": made.seconds,
                    "pixels": round(made.error, 3),
                }
            ),
            flush=True,
        )


def _of_frames(folder: Path, found: Sequence, listing: Sequence, files: Sequence) -> list:
    """The true pose of each found frame: of the photo that looks most like it."""
    small = [np.array(Image.open(f).convert("L").resize((96, 64)), np.float32) for f in files]
    poses = []
    for frame in found:
        image = Image.open(folder / frame.name).convert("L").resize((96, 64))
        gap = [np.abs(np.array(image, np.float32) - other).mean() for other in small]
        poses.append(listing[int(np.argmin(gap))].c2w)
    return poses


if __name__ == "__main__":
    main()
