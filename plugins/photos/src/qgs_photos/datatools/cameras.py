"""Poses and intrinsics of a scene: each by itself, and poses against each other."""

from collections.abc import Iterator, Sequence

import numpy as np

from qgs.data.lenses import Intrinsics, Size
from qgs.data.photos.checks import FrameProblem, intrinsics_problems, pose_problems
from qgs_photos.datatools.decoding import DecodedScene
from qgs_photos.datatools.findings import Finding

# Of a rotation's entries, and of coordinates that float32 holds.
_SAME = 2e-6
# Of coordinates that float64 holds, after they were computed.
_DOUBLE = 1e-9
# Of coordinates that were float32 before they were written.
_FLOAT32 = 2e-7
# Of the cameras' extent: the largest distance that counts as none.
_OF_EXTENT = 1e-4
# Of a side, from the middle.
_FAR_OFF_CENTRE = 0.25


def camera_findings(scene: DecodedScene, sized: set[int]) -> tuple[list[Finding], list[Finding]]:
    """Return faults of poses, and of the rest. sized: frames whose listed size is wrong."""
    poses: list[Finding] = []
    others: list[Finding] = []
    for frame, (photo, result) in enumerate(zip(scene.photos, scene.decoded, strict=True)):
        listed = photo.listed
        if not listed.problems or np.isfinite(listed.c2w).all():
            for problem in pose_problems(listed.c2w):
                poses.append(scene.finding([frame], problem.reason, problem.fix))
        rest = list(listed.problems)
        if not rest and frame not in sized:
            rest = _intrinsics_problems(listed.intrinsics, listed.size or result.size)
        others += [scene.finding([frame], problem.reason, problem.fix) for problem in rest]
    return poses, others


def _intrinsics_problems(intrinsics: Intrinsics, size: Size | None) -> list[FrameProblem]:
    problems = list(intrinsics_problems(intrinsics, size))
    if size is None or problems:
        return problems
    height, width = size
    _, _, cx, cy = intrinsics
    if max(abs(cx / width - 0.5), abs(cy / height - 0.5)) <= _FAR_OFF_CENTRE:
        return []
    reason = (
        f"the principal point ({cx:.6g}, {cy:.6g}) is far from the middle of the {width} x "
        f"{height} pixels"
    )
    fix = "correct cx and cy, unless the photo is cut from a larger one"
    return [FrameProblem("intrinsics", reason, fix, fatal=False)]


def sharing_findings(
    scene: DecodedScene, usable: Sequence[int], *, float32: bool
) -> Iterator[Finding]:
    """Yield frames of `usable` that share a pose or a place. float32: precision of the format."""
    if len(usable) < 2:
        return
    poses = np.stack([scene.photos[frame].listed.c2w for frame in usable])
    # exact poses may be close, rounded ones are equal by chance
    near, one_point = _tolerances(poses, float32)
    if np.ptp(poses[:, :3, 3], axis=0).max() <= one_point:
        reason = f"all {len(usable)} cameras stand on one point, so that depth is undetermined"
        yield scene.finding(usable, reason, "export the poses with their translations")
        return
    for place in _groups(poses[:, :3, 3], near):
        groups = _groups(poses[place, :3, :3].reshape(len(place), 9), _SAME)
        alike = [[usable[place[index]] for index in group] for group in groups]
        for first, *others in alike:
            yield from _duplicates(scene, first, others)
        first, *rest = (group[0] for group in alike)
        if rest:
            yield scene.finding(
                rest,
                f"the camera stands on the same point as that of {scene.label(first)}, a zero "
                "baseline, which determines no depth",
                "correct the position, or remove one of the frames",
            )


def _tolerances(poses: np.ndarray, float32: bool) -> tuple[float, float]:
    """Return distances up to which two cameras, and all, share a point, by the poses' precision."""
    rotations = poses[:, :3, :3]
    centres = poses[:, :3, 3]
    off_rigid = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max((1, 2))
    distance = np.abs(centres).max()
    extent = np.ptp(centres, axis=0).max()
    precision = max(_SAME if float32 else _DOUBLE, float(np.median(off_rigid)))
    # far from the origin, as on maps, float32 cannot tell centres apart
    together = _SAME if float32 else min(precision, _FLOAT32)
    return min(distance * precision, extent * _OF_EXTENT), distance * together


def _groups(rows: np.ndarray, tolerance: float) -> list[list[int]]:
    """Return groups of indices of rows (F, D) that differ from the group's first by no more."""
    # sorted by one coordinate, a row is compared with few: thousands of frames take no second
    order = np.argsort(rows[:, 0], kind="stable")
    column = rows[order, 0]
    groups: dict[int, list[int]] = {}
    leader = np.full(len(rows), -1)
    for index in range(len(rows)):
        if leader[index] >= 0:
            groups[leader[index]].append(index)
            continue
        groups[index] = [index]
        low, high = np.searchsorted(column, rows[index, 0] + np.array([-1.0, 1.0]) * tolerance)
        near = order[low : high + 1]
        same = near[np.abs(rows[near] - rows[index]).max(1) <= tolerance]
        leader[same[leader[same] < 0]] = index
    return list(groups.values())


def _duplicates(scene: DecodedScene, first: int, others: Sequence[int]) -> Iterator[Finding]:
    label = scene.label(first)
    digest = scene.decoded[first].digest
    for frame in others:
        # a camera that stands still may film what moves
        if scene.photos[first].listed.time != scene.photos[frame].listed.time:
            continue
        if digest and digest == scene.decoded[frame].digest:
            reason = f"the photo and its pose repeat {label}"
            yield scene.finding([frame], reason, "remove one of the two", "warning")
        else:
            reason = f"the pose repeats that of {label}, whose photo is another one"
            yield scene.finding([frame], reason, "correct the pose, or remove one of the frames")
