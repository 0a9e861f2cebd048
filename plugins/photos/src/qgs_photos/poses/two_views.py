"""Find the relative pose and the focal length of two photos from their matching features.

Matches of all qualities take part: each has a chance to be right, and a mixture of noise and of
wrong matches scores poses. So no threshold decides which matches count. COLMAP's RANSAC only
proposes poses, at several focal lengths if none is known.

Points are in pixels from the middle of a photo. Those of the second photo are scaled, so that both
photos have the focal length of the first. A pose maps points of the first camera to the second,
y = rotation @ x + translation, in OpenCV axes; the translation has length 1.
Axes: K hypotheses, N matches.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pycolmap

Array = npt.NDArray[Any]
# Takes dictionaries for options, which its types do not say.
COLMAP: Any = pycolmap

FOCALS = tuple(np.geomspace(0.6, 3.2, 8))
"""Focal lengths to propose if the true one is unknown, in units of the longer side."""
USUAL = (1.2, 0.8)
"""Median of usual focal lengths in units of the longer side, and deviation of their logarithm."""
EXIF = 0.01
"""Deviation of the logarithm of focal lengths that EXIF gives."""
SETS = ((0.57, 2.0), (0.117, 2.0), (0.867, 2.0), (0.57, 1.0))
"""Matches for RANSAC: least chance to be right, and largest error in pixels. Only the first two
sets are used if the focal length is unknown."""
TRIALS = {"random_seed": 0, "min_num_trials": 100, "max_num_trials": 2000}
MOST_MATCHES = 1000
WORST_RATIO = 0.97
NOISE = ((0.5, 0.25), (0.35, 0.8), (0.15, 3.0))
"""Weights and standard deviations in pixels of the errors of right matches."""
WRONG = 0.4
"""Range of the errors of wrong matches, in units of the longer side."""
STEPS = 20
"""Number of steps of the refinement."""
_STEP = 1e-5


@dataclass(frozen=True)
class View:
    """Features of a photo.

    points: (n, 2). side: longer side in pixels. focal: focal length in pixels; None if unknown.
    """

    points: Array
    side: float
    focal: float | None


class Limits(NamedTuple):
    """Limits for pairs with one kind of features, see `TwoViews`.

    score: least score of a pair that counts. flat: share of matches that a plane explains, from
    which on a pair does not give the focal length.
    """

    score: float
    flat: float


class Links(NamedTuple):
    """Matches of two photos.

    indices: (N, 2) of the features of both. right: (N,) chance of each match to be right. limits:
    those of a pair that has such features.
    """

    indices: Array
    right: Array
    limits: Limits


SIFT = Limits(score=150, flat=0.97)
"""Limits that 90 % of 200 real pairs meet if the focal length is known, and 85 % if it is not; 0 %
and 3 % of these have errors above 20 degrees."""


@dataclass(frozen=True)
class Matches:
    """Matches of two photos, with their points.

    indices, right: as in `Links`. one, other: (N, 2) points. scale: factor of the points of the
    second photo. side: longer side in pixels of the first photo. prior: mean and deviation of the
    logarithm of its focal length in pixels.
    """

    indices: Array
    right: Array
    one: Array
    other: Array
    scale: float
    side: float
    prior: tuple[float, float]


class Poses(NamedTuple):
    """K poses: rotations (K, 3, 3), unit translations (K, 3), focals (K,) in pixels.

    scores: (K,) log likelihood ratio to wrong matches alone, and log prior. errors: (K, N) signed
    Sampson errors in pixels. weights: (K, N) of their squares.
    """

    rotations: Array
    translations: Array
    focals: Array
    scores: Array
    errors: Array
    weights: Array


@dataclass(frozen=True)
class TwoViews:
    """Pose of the second camera, focal lengths of both in pixels, and how sure they are.

    rotation: (3, 3). translation: (3,). points: (n, 3) of right matches, in the frame of the first
    camera. indices: (n, 2) of their features. score: log likelihood ratio to wrong matches alone.
    focal_doubt: standard deviation of the logarithm of the focal length. flat: share of right
    matches that a plane explains.
    """

    rotation: Array
    translation: Array
    focals: tuple[float, float]
    points: Array
    indices: Array
    score: float
    focal_doubt: float
    flat: float

    @property
    def depth(self) -> float:
        """Median depth of the points; infinite without points."""
        return float(np.median(self.points[:, 2])) if len(self.points) else np.inf


def two_views(one: View, other: View, links: Links, doubt: float = EXIF) -> TwoViews | None:
    """Return the most likely pose and focal length; None if there are too few matches.

    doubt: deviation of the logarithm of known focal lengths, whose proportion is kept.
    """
    if one.focal and other.focal:
        scale = one.focal / other.focal
        prior = np.log(one.focal), doubt
    else:
        scale = one.side / other.side
        prior = np.log(USUAL[0] * one.side), USUAL[1]
    points = one.points[links.indices[:, 0]].astype(float)
    others = other.points[links.indices[:, 1]].astype(float) * scale
    matches = Matches(links.indices, links.right, points, others, scale, one.side, prior)
    found = [*_proposed(matches)]
    if not found:
        return None
    rotations, translations, focals = map(np.array, zip(*found, strict=True))
    poses = refined(_scored(rotations, translations, focals, matches), matches)
    best = poses.scores.argmax()
    return _verdict(Poses(*(own[[best]] for own in poses)), matches)


def linked(one: Array, other: Array) -> Links:
    """Return mutual nearest features, at most MOST_MATCHES of the most likely ones.

    one, other: descriptors (n, 128) of length 1. How much nearer a match is than the second best
    says how likely it is right.
    """
    similar = one @ other.T
    best = similar.argmax(1)
    rows = np.nonzero(similar.argmax(0)[best] == np.arange(len(best)))[0]
    best = best[rows]
    first = similar[rows, best]
    # without the mutual matches, the second best of both directions are left
    similar[rows, best] = -1
    second = np.maximum(similar[rows].max(1), similar.max(0)[best])
    ratios = np.arccos(first.clip(0, 1 - 1e-6)) / np.arccos(second.clip(0, 1 - 1e-6))
    order = ratios.argsort(kind="stable")[:MOST_MATCHES]
    order = order[ratios[order] < WORST_RATIO]
    right = 0.01 + 0.9 / (1 + np.exp((ratios[order] - 0.82) / 0.04))
    return Links(np.c_[rows, best][order], right, SIFT)


def _proposed(matches: Matches) -> Iterator[tuple[Array, Array, float]]:
    """Yield the rotation, translation and focal length of each pose that RANSAC finds."""
    known = matches.prior[1] == EXIF
    sets = SETS if known else SETS[:2]
    for focal in [np.exp(matches.prior[0])] if known else np.multiply(FOCALS, matches.side):
        # points are from the middle, so the size does not matter
        camera = COLMAP.Camera(model="SIMPLE_PINHOLE", width=1, height=1, params=[focal, 0, 0])
        for least, error in sets:
            kept = matches.right > least
            options = TRIALS | {"max_error": error}
            result = COLMAP.estimate_relative_pose(
                camera, matches.one[kept], camera, matches.other[kept], options
            )
            if result is not None:
                pose = result["cam2_from_cam1"].matrix()
                yield pose[:, :3], pose[:, 3] / np.linalg.norm(pose[:, 3]), focal


def _scored(rotations: Array, translations: Array, focals: Array, matches: Matches) -> Poses:
    one = _rays(matches.one, focals)
    other = _rays(matches.other, focals)
    # of the cross product with the translation, times the rotation
    essential = np.cross(translations[:, None], rotations.mT).mT
    lines = one @ essential.mT
    back = other @ essential
    slope = (lines[..., :2] ** 2).sum(-1) + (back[..., :2] ** 2).sum(-1)
    # Sampson errors
    errors = (other * lines).sum(-1) / np.sqrt(slope + 1e-24) * focals[:, None]
    gains, weights = likelihood(errors, matches)
    mean, deviation = matches.prior
    scores = gains.sum(-1) - 0.5 * ((np.log(focals) - mean) / deviation) ** 2
    return Poses(rotations, translations, focals, scores, errors, weights)


def _rays(points: Array, focals: Array) -> Array:
    """Return directions (K, N, 3) of points (N, 2), with z = 1."""
    scaled = points / focals[:, None, None]
    return np.c_[scaled, np.ones_like(scaled[..., :1])]


def likelihood(errors: Array, matches: Matches) -> tuple[Array, Array]:
    """Return log likelihood ratios of errors (K, N) to wrong matches, and weights of squares."""
    weights, deviations = np.array(NOISE).T[..., None, None]
    densities = np.exp(-0.5 * (errors / deviations) ** 2) / (np.sqrt(2 * np.pi) * deviations)
    densities *= weights * matches.right
    wrong = WRONG * matches.side
    total = densities.sum(0) + (1 - matches.right) / wrong
    return np.log(total * wrong), (densities / deviations**2).sum(0) / total


def refined(poses: Poses, matches: Matches) -> Poses:
    """Refine `poses`, in place and returned, by Levenberg and Marquardt's method."""
    damping = np.full(len(poses.focals), 1e-3)
    for _ in range(STEPS):
        normal, slope = _normal(poses, matches)
        diagonal = np.einsum("kii->ki", normal)
        diagonal += damping[:, None] * diagonal
        step = -np.linalg.solve(normal, slope[..., None])[..., 0]
        tried = _stepped(poses, step, matches)
        gain = tried.scores - poses.scores
        better = gain > 0
        damping = np.where(better, damping / 5, damping * 8)
        for old, new in zip(poses, tried, strict=True):
            old[better] = new[better]
    return poses


def _normal(poses: Poses, matches: Matches) -> tuple[Array, Array]:
    """Return the normal matrices (K, 7, 7) of one step and the gradients (K, 7)."""
    moved = (_stepped(poses, _STEP * row, matches) for row in np.eye(7))
    slopes = np.stack([(each.errors - poses.errors) / _STEP for each in moved], -1)
    weighted = slopes * poses.weights[..., None]
    normal = weighted.mT @ slopes
    gradient = (weighted * poses.errors[..., None]).sum(1)
    # the length of a translation has no effect
    normal += 1e-6 * np.eye(7)
    mean, deviation = matches.prior
    normal[:, 6, 6] += deviation**-2
    gradient[:, 6] += (np.log(poses.focals) - mean) * deviation**-2
    return normal, gradient


def _stepped(poses: Poses, step: Array, matches: Matches) -> Poses:
    """Return moved poses.

    step: (K, 7) or (7,), rotation vector, translation, logarithm of the focal length.
    """
    step = np.broadcast_to(step, (len(poses.focals), 7))
    turns = np.stack([COLMAP.Rotation3d(axis_angle).matrix() for axis_angle in step[:, :3]])
    translations = poses.translations + step[:, 3:6]
    translations /= np.linalg.norm(translations, axis=1, keepdims=True)
    focals = poses.focals * np.exp(step[:, 6])
    return _scored(turns @ poses.rotations, translations, focals, matches)


def _verdict(best: Poses, matches: Matches) -> TwoViews:
    """Return the pose `best` (K = 1), with the sign of translation at which points are in front."""
    gains = likelihood(best.errors, matches)[0][0]
    # probability to be right, now that the pose is known
    chances = 1 - (1 - matches.right) * np.exp(-gains)
    one = _rays(matches.one, best.focals)[0]
    other = _rays(matches.other, best.focals)[0]
    rotation = best.rotations[0]
    translation = best.translations[0]
    # depths in both cameras, by least squares: depth * one @ rotation.T + translation = other
    system = np.stack([-one @ rotation.T, other], -1)
    depths = (np.linalg.pinv(system) @ translation[:, None])[..., 0]
    sign = 1.0 if (np.sign(depths) * chances[:, None]).sum() >= 0 else -1.0
    depths = sign * depths
    front = depths.min(1) > 0
    right = front & (chances > 0.5)
    # of what would lie behind a camera, no match is right
    score = best.scores[0] + (np.log1p(-matches.right) - gains)[~front].sum()
    covariance = np.linalg.inv(_normal(best, matches)[0])[0]
    focal = float(best.focals[0])
    return TwoViews(
        rotation=rotation,
        translation=sign * translation,
        focals=(focal, focal / matches.scale),
        points=(one * depths[:, :1])[right],
        indices=matches.indices[right],
        score=float(score),
        focal_doubt=float(np.sqrt(covariance[6, 6])),
        flat=_flat(matches.one[right], matches.other[right]),
    )


def _flat(one: Array, other: Array) -> float:
    """Return the share of matches (n, 2) that one plane explains."""
    options = {"random_seed": 0, "max_error": 3.0}
    found = COLMAP.estimate_homography_matrix(one, other, options)
    return found["num_inliers"] / len(one) if found else 0.0
