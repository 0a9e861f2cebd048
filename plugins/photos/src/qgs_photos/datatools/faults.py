"""Find faults of single photos and poses, and photos that have the same pose or position."""

from collections.abc import Iterator, Sequence
from itertools import compress

import numpy as np
from scipy.spatial import KDTree

from qgs.data.images import TURN, TURNED
from qgs.data.photos.reader import (
    UNLESS,
    FrameProblem,
    are_plausible,
    intrinsics_problems,
    pose_problems,
    size_problems,
)
from qgs.wording import numbered
from qgs_photos.datatools.findings import Finding
from qgs_photos.datatools.photos import Decoded, DecodedScene

# Of a rotation's entries.
_SAME = 2e-6
# Of the cameras' extent: the largest distance that counts as none, the rounding of float32.
_OF_EXTENT = 5e-7
# Times: the gain in edges that shows an exchange. Right masks of 69 photos gain at most 1.01.
_BETTER = 1.2


def photo_findings(scene: DecodedScene) -> Iterator[Finding]:
    """Yield faults of image files, listed image sizes, intrinsics and masks."""
    for frame, (photo, result) in enumerate(zip(scene.photos, scene.decoded, strict=True)):
        listed = photo.listed
        if result.unturned:
            yield scene.finding([frame], f"photos {TURNED}", TURN, "warning")
        problems = list(listed.problems)
        # a wrong size makes intrinsics look wrong
        problems += size_problems(result.size, listed.size) if result.size else ()
        size = listed.size or result.size
        problems = problems or [*intrinsics_problems(listed.intrinsics, size)]
        if size and not problems and not are_plausible(listed.intrinsics, size):
            fx, fy, cx, cy = listed.intrinsics
            values = f"(fx {fx:.6g}, fy {fy:.6g}, cx {cx:.6g}, cy {cy:.6g})"
            reason = f"the intrinsics {values} are implausible for {size[1]} x {size[0]} pixels"
            problems = [FrameProblem(reason, UNLESS)]
        for problem in (*result.errors, *problems):
            yield scene.finding([frame], problem.reason, problem.fix)
    if exchanged := _with_exchanged_masks(scene.decoded):
        reason = "the mask fits another photo better, and the mask of that photo fits this one"
        yield scene.finding(exchanged, reason, "give each photo its own mask", "warning")
    empty = [frame for frame, result in enumerate(scene.decoded) if result.empty_mask]
    if empty:
        every = all(result.empty_mask in (True, None) for result in scene.decoded)
        reason = "the mask is black, so that nothing of the photo is modelled"
        fix = "make masks white where the photo is to be modelled, or list no masks"
        yield scene.finding(empty, reason, fix, "error" if every else "warning")


def _with_exchanged_masks(photos: Sequence[Decoded]) -> list[int]:
    """Return the indices of photos that fit each other's masks better than their own.

    A mask fits a photo if its border runs along edges of the photo. Each of two photos must fit
    the other's mask best of all: textures behind small masks favour any mask but no certain one.
    """
    masked = {frame: photo.edges for frame, photo in enumerate(photos) if photo.edges is not None}
    if not masked:
        return []
    edges, borders = np.stack([*masked.values()], 1)
    borders = borders > 0
    fits = edges @ borders.T / borders.sum(1).clip(1)
    best = fits.argmax(1)
    better = fits.max(1) > _BETTER * fits.diagonal()
    mutual = best[best] == np.arange(len(best))
    return [*compress(masked, better & mutual)]


def pose_findings(scene: DecodedScene) -> Iterator[Finding]:
    """Yield faults of single poses, such as NaN or a mirrored rotation."""
    for frame, photo in enumerate(scene.photos):
        listed = photo.listed
        if not listed.problems or np.isfinite(listed.c2w).all():
            for problem in pose_problems(listed.c2w):
                yield scene.finding([frame], problem.reason, problem.fix)


def sharing_findings(scene: DecodedScene, usable: Sequence[int]) -> Iterator[Finding]:
    """Yield findings for frames with the pose or the position of another frame.

    usable: indices of the frames to compare, which have no other faults.
    """
    if len(usable) < 2:
        return
    poses = np.stack([scene.photos[frame].listed.c2w for frame in usable])
    centres = poses[:, :3, 3]
    extent = np.ptp(centres, axis=0).max()
    if not extent:
        reason = f"all {len(usable)} cameras stand on one point, so that depth is undetermined"
        yield scene.finding(usable, reason, "export the poses with their translations")
        return
    told = set[int]()
    for pair in sorted(KDTree(centres).query_pairs(_OF_EXTENT * extent)):
        first, frame = (usable[place] for place in pair)
        if frame in told:
            continue
        told.add(frame)
        one, other = poses[[*pair], :3, :3]
        name = scene.photos[first].listed.name
        number = scene.numbers[first]
        label = name if number is None else f"frame {numbered(number, name)}"
        digest = scene.decoded[first].digest
        if np.abs(one - other).max() > _SAME:
            reason = f"the camera stands on the same point as that of {label}"
            fix = "correct the position, or remove one of the frames: the two show no depth"
            yield scene.finding([frame], reason, fix)
        # a camera that stands still may film what moves
        elif scene.photos[first].listed.time != scene.photos[frame].listed.time:
            continue
        elif digest and digest == scene.decoded[frame].digest:
            reason = f"the photo and its pose repeat {label}"
            yield scene.finding([frame], reason, "remove one of the two", "warning")
        else:
            reason = f"the pose repeats that of {label}, which has a different photo"
            yield scene.finding([frame], reason, "correct the pose, or remove one of the frames")
