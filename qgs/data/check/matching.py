"""Points that two photos share: SIFT features that one fundamental matrix explains."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from qgs.contracts.extras import MissingExtraError

MIN_MATCHES = 24
"""Fewer matches than this say nothing about a pair of photos."""

_RATIO = 0.8  # of descriptor distances (Lowe 2004)
_INLIER_PIXELS = 1.5
_TRIALS = 400


@dataclass(frozen=True)
class Features:
    """SIFT features of one photo. points: (P, 2) x, y in pixels. descriptors: (P, 128)."""

    points: np.ndarray
    descriptors: np.ndarray


@dataclass(frozen=True)
class Matches:
    """The same P scene points in two photos. first, second: (P, 2) x, y in pixels."""

    first: np.ndarray
    second: np.ndarray

    def __len__(self) -> int:
        return len(self.first)


def detect(grey: np.ndarray) -> Features:
    """Features of an image (H, W) in [0, 1]. Raises MissingExtraError without scikit-image."""
    sift = _skimage().feature.SIFT()
    try:
        sift.detect_and_extract(grey)
    except RuntimeError:  # an image without any feature, such as a plain wall
        return Features(np.zeros((0, 2)), np.zeros((0, 128)))
    return Features(sift.keypoints[:, ::-1] + 0.5, sift.descriptors)


def match(first: Features, second: Features, seed: int = 0) -> Matches:
    """Mutual matches that agree with one epipolar geometry, found from the photos alone.

    Poses play no part, so that wrong ones cannot hide behind the matches that they reject. Empty
    when fewer than MIN_MATCHES remain.
    """
    nothing = Matches(np.zeros((0, 2)), np.zeros((0, 2)))
    if min(len(first.points), len(second.points)) < MIN_MATCHES:
        return nothing
    pairs = _skimage().feature.match_descriptors(
        first.descriptors, second.descriptors, max_ratio=_RATIO, cross_check=True
    )
    if len(pairs) < MIN_MATCHES:
        return nothing
    a, b = first.points[pairs[:, 0]], second.points[pairs[:, 1]]
    _, inliers = _skimage().measure.ransac(
        (a, b),
        _skimage().transform.FundamentalMatrixTransform,
        min_samples=8,
        residual_threshold=_INLIER_PIXELS,
        max_trials=_TRIALS,
        rng=seed,
    )
    if inliers is None or inliers.sum() < MIN_MATCHES:
        return nothing
    return Matches(a[inliers], b[inliers])


@lru_cache(maxsize=1)
def _skimage() -> Any:
    try:
        import skimage.feature
        import skimage.measure
        import skimage.transform
    except ImportError as error:
        raise MissingExtraError(
            "matching photos needs scikit-image: `pip install qgs[check]`"
        ) from error
    return skimage
