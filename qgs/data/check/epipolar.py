"""Whether poses agree with photos: matches against the epipolar lines that the poses predict."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from qgs.data.check.conventions import AS_READ, Convention, Reading, readings
from qgs.data.check.matching import Matches

TOLERANCE = 0.005
"""Largest median distance that good poses leave, as a fraction of the image's diagonal."""

CLEARLY_BETTER = 3.0
"""A reading replaces the present one when its distance is this many times smaller."""


@dataclass(frozen=True)
class Pair:
    """Two frames and what they share.

    poses: (2, 4, 4) camera-to-world, OpenCV axes as read. intrinsics: (2, 4) fx, fy, cx, cy.
    size: (H, W) of both photos, pixels.
    """

    frames: tuple[int, int]
    matches: Matches
    poses: np.ndarray
    intrinsics: np.ndarray
    size: tuple[int, int]

    def distance(self, reading: Reading = np.asarray) -> float:
        """Median epipolar distance, as a fraction of the diagonal, if poses are meant so."""
        first, second = (reading(pose) for pose in self.poses)
        distances = epipolar_distances(self.matches, first, second, self.intrinsics)
        return float(np.median(distances) / np.hypot(*self.size))


@dataclass(frozen=True)
class Verdict:
    """distances: median over pairs for each reading, fractions of the diagonal."""

    distances: Mapping[str, float]

    @property
    def agrees(self) -> bool:
        """Whether the poses, as read, explain the photos."""
        return self.distances[AS_READ] <= TOLERANCE and self.better is None

    @property
    def better(self) -> str | None:
        """The reading that explains the photos where the present one does not."""
        best = min(self.distances, key=lambda reading: self.distances[reading])
        clear = self.distances[AS_READ] > CLEARLY_BETTER * self.distances[best]
        return best if clear and self.distances[best] <= TOLERANCE else None


def judge(pairs: Sequence[Pair], convention: Convention) -> Verdict:
    """Compare on at least one pair what poses of a format may have been meant as."""
    return Verdict(
        {
            name: float(np.median([pair.distance(reading) for pair in pairs]))
            for name, reading in readings(convention).items()
        }
    )


def epipolar_distances(
    matches: Matches, first: np.ndarray, second: np.ndarray, intrinsics: np.ndarray
) -> np.ndarray:
    """Distance in pixels of each point (P,) to the epipolar line of its partner, both ways' mean.

    Arguments as of `epipolar_lines`. Two cameras on one point have no epipolar lines: all distances
    are then 0.
    """
    back, forth = epipolar_lines(matches, first, second, intrinsics)
    return (_line_distance(matches.second, forth) + _line_distance(matches.first, back)) / 2


def epipolar_lines(
    matches: Matches, first: np.ndarray, second: np.ndarray, intrinsics: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The lines (P, 3) of points in the first photo and in the second on which matches must lie.

    A line is a, b, c of a x + b y + c = 0, in pixels; each is that of the point in the other photo.
    first, second: (4, 4) camera-to-world, OpenCV axes. intrinsics: (2, 4). The fundamental matrix
    is that of Hartley and Zisserman (2004), section 9.2.
    """
    relative = np.linalg.inv(second) @ first
    rotation, shift = relative[:3, :3], relative[:3, 3]
    x, y, z = shift
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    inverse = [np.linalg.inv(_matrix(values)) for values in intrinsics]
    fundamental = inverse[1].T @ cross @ rotation @ inverse[0]
    a, b = _homogeneous(matches.first), _homogeneous(matches.second)
    return b @ fundamental, a @ fundamental.T


def _line_distance(points: np.ndarray, lines: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(lines[:, :2], axis=1)
    return np.abs((_homogeneous(points) * lines).sum(1)) / np.where(length > 0, length, 1.0)


def _homogeneous(points: np.ndarray) -> np.ndarray:
    return np.concatenate([points, np.ones((len(points), 1))], 1)


def _matrix(intrinsics: np.ndarray) -> np.ndarray:
    fx, fy, cx, cy = intrinsics
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
