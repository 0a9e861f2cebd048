"""Poses and intrinsics of a scene: each by itself, and poses against each other."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from qgs.data.lenses import Intrinsics, Size
from qgs.data.photos.checks import FrameProblem, intrinsics_problems, pose_problems
from qgs_datatools.decoding import Decoded
from qgs_datatools.findings import Finding, Photo

_SAME = 2e-6  # of a rotation's entries, and of coordinates that float32 holds
_DOUBLE = 1e-9  # of coordinates that float64 holds, after they were computed
_FLOAT32 = 2e-7  # of coordinates that were float32 before they were written
_OF_EXTENT = 1e-4  # of the cameras' extent: farther apart, they stand apart
_FAR_OFF_CENTRE = 0.25  # of a side, from the middle


def camera_findings(
    scene: str, photos: Sequence[Photo], decoded: Sequence[Decoded], sized: set[int]
) -> tuple[list[Finding], list[Finding]]:
    """What is wrong with single poses, and with intrinsics and the rest.

    sized: frames whose listed size is wrong, so that their intrinsics cannot be judged.
    """
    poses: list[Finding] = []
    others: list[Finding] = []
    for frame, (photo, result) in enumerate(zip(photos, decoded, strict=True)):
        listed = photo.listed
        unread = bool(listed.problems) and not np.isfinite(listed.c2w).all()
        of_pose = [] if unread else list(pose_problems(listed.c2w))
        rest = list(listed.problems)
        if not listed.problems and frame not in sized:
            rest += _intrinsics(listed.intrinsics, listed.size or result.size)
        for problems, found in ((of_pose, poses), (rest, others)):
            found += [
                Finding(scene, problem.reason, problem.fix, (frame,), (listed.name,))
                for problem in problems
            ]
    return poses, others


def _intrinsics(intrinsics: Intrinsics, size: Size | None) -> Iterator[FrameProblem]:
    problems = list(intrinsics_problems(intrinsics, size))
    yield from problems
    if size is None or problems:
        return
    height, width = size
    _, _, cx, cy = intrinsics
    if max(abs(cx / width - 0.5), abs(cy / height - 0.5)) > _FAR_OFF_CENTRE:
        yield FrameProblem(
            "intrinsics",
            f"the principal point ({cx:.6g}, {cy:.6g}) is far from the middle of the {width} x "
            f"{height} pixels",
            "correct cx and cy, unless the photo is cut from a larger one",
            fatal=False,
        )


@dataclass(frozen=True)
class _Camera:
    frame: int
    name: str
    c2w: np.ndarray
    digest: bytes


def sharing_findings(
    scene: str,
    photos: Sequence[Photo],
    decoded: Sequence[Decoded],
    sound: Sequence[int],
    *,
    float32: bool,
) -> list[Finding]:
    """Photos that share a pose, or only a place, among the frames whose poses are `sound`.

    float32: whether the format holds poses in float32.
    """
    cameras = [
        _Camera(frame, photos[frame].listed.name, photos[frame].listed.c2w, decoded[frame].digest)
        for frame in sound
    ]
    if len(cameras) < 2:
        return []
    centres = np.stack([camera.c2w[:3, 3] for camera in cameras])
    extent = float(np.ptp(centres, axis=0).max())
    near, one_point = _tolerances(centres, extent, _rigidity(cameras), float32)
    if extent <= one_point:
        return [
            Finding(
                scene,
                f"all {len(cameras)} cameras stand on one point, so that no depth can be told",
                "export the poses with their translations",
                tuple(camera.frame for camera in cameras),
                tuple(camera.name for camera in cameras),
            )
        ]
    findings: list[Finding] = []
    for place in _together(cameras, lambda camera: camera.c2w[:3, 3], near):
        groups = list(_together(place, lambda camera: camera.c2w[:3, :3].flatten(), _SAME))
        for alike in groups:
            findings += [_duplicate(scene, alike[0], other) for other in alike[1:]]
        if len(groups) > 1:
            findings.append(_zero_baseline(scene, [alike[0] for alike in groups]))
    return findings


def _tolerances(
    centres: np.ndarray, extent: float, rigidity: float, float32: bool
) -> tuple[float, float]:
    """How far apart two cameras, and all cameras, may be on one point, in the world's units.

    Coordinates are as precise as the format, or as the rotations beside them; far from the origin
    such errors exceed the steps between cameras, so that the extent bounds what is one place.
    """
    distance = float(np.abs(centres).max())
    precision = max(_SAME if float32 else _DOUBLE, rigidity)
    together = _SAME if float32 else min(precision, _FLOAT32)
    return min(distance * precision, extent * _OF_EXTENT), distance * together


def _together(
    cameras: Sequence[_Camera], values: Callable[[_Camera], np.ndarray], tolerance: float
) -> list[list[_Camera]]:
    """Groups of cameras whose values differ from those of the group's first by no more.

    Sorted by the first value, so that only cameras near in it are compared.
    """
    rows = np.stack([values(camera) for camera in cameras])
    order = np.argsort(rows[:, 0], kind="stable")
    sorted_ = rows[order, 0]
    groups: dict[int, list[_Camera]] = {}
    leader = np.full(len(cameras), -1)
    for place, camera in enumerate(cameras):
        if leader[place] >= 0:
            groups[leader[place]].append(camera)
            continue
        groups[place] = [camera]
        low, high = np.searchsorted(sorted_, rows[place, 0] + np.array([-1.0, 1.0]) * tolerance)
        near = order[low : high + 1]
        alike = near[np.abs(rows[near] - rows[place]).max(1) <= tolerance]
        leader[alike[leader[alike] < 0]] = place
    return list(groups.values())


def _rigidity(cameras: Sequence[_Camera]) -> float:
    """How far rotations are from orthonormal in the median; centres are no better known."""
    rotations = np.stack([camera.c2w[:3, :3] for camera in cameras])
    errors = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max((1, 2))
    return float(np.median(errors))


def _duplicate(scene: str, first: _Camera, second: _Camera) -> Finding:
    frames, names = (second.frame,), (second.name,)
    which = f"frame {first.frame} ({first.name})"
    if first.digest and first.digest == second.digest:
        return Finding(
            scene, f"the photo and its pose repeat {which}", "remove one of the two",
            frames, names, "warning",
        )  # fmt: skip
    return Finding(
        scene, f"the pose repeats that of {which}, whose photo is another one",
        "correct the pose, or remove one of the frames", frames, names,
    )  # fmt: skip


def _zero_baseline(scene: str, cameras: Sequence[_Camera]) -> Finding:
    first, *rest = cameras
    return Finding(
        scene,
        f"the camera stands on the same point as that of frame {first.frame} ({first.name}), a "
        "zero baseline, so that the two tell no depth",
        "correct the position, or remove one of the frames",
        tuple(camera.frame for camera in rest),
        tuple(camera.name for camera in rest),
    )
