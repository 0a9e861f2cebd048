"""Confidence intervals of mean differences: over scenes, or over trainings and scenes."""

import numpy as np
from scipy.stats import bootstrap
from scipy.stats import t as student

RESAMPLES = 10_000
CONFIDENCE = 0.95
SEED = 0
_AT_A_TIME = 1_000_000
"""Numbers that the bootstrap draws at once, which bounds its memory."""


def crossed_interval(
    values: np.ndarray, confidence: float = CONFIDENCE
) -> tuple[float, float] | None:
    """Return the interval of the mean of differences (S, C) of S trainings on the same C scenes.

    Both are random: it holds for other trainings and for other scenes; see `crossed_error`. None
    for fewer than two of either.
    """
    if min(values.shape) < 2:
        return None
    error, freedom = crossed_error(values)
    half = float(student.ppf((1 + confidence) / 2, freedom) * error)
    return float(values.mean() - half), float(values.mean() + half)


def interval(
    values: np.ndarray, confidence: float = CONFIDENCE
) -> tuple[float, float] | tuple[None, None]:
    """Return the interval of the mean of differences (S, C) of S trainings on C scenes.

    Of one training it covers scenes alone, at 95 %; without an interval (None, None), as of one
    scene.
    """
    return crossed_interval(values, confidence) or paired_interval(values[0]) or (None, None)


def crossed_error(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the standard error of the means of `values` (..., S, C), and its degrees of freedom.

    Both have the shape (...). The variance is that of two-way analysis of variance, a sum of mean
    squares; its degrees of freedom are those of Satterthwaite 1946 (doi.org/10.2307/3002019), at
    least those of the smaller side. Without the scenes' own (Hillis 2007, doi.org/10.1002/sim.2532)
    it is too narrow for few.
    """
    *_, trainings, scenes = values.shape
    of_training = values.mean(-1, keepdims=True)
    of_scene = values.mean(-2, keepdims=True)
    # The interaction, which is also the noise of a single score.
    rest = values - of_training - of_scene + values.mean((-2, -1), keepdims=True)
    noise = (rest**2).sum((-2, -1)) / ((trainings - 1) * (scenes - 1))
    first = scenes * of_training.var((-2, -1), ddof=1)
    second = trainings * of_scene.var((-2, -1), ddof=1)
    # Otherwise the scenes add no variance of their own, and the difference would be negative.
    own = second > noise
    whole = first + own * (second - noise)
    spread = first**2 + own * (second**2 * (trainings - 1) + noise**2) / (scenes - 1)
    freedom = (trainings - 1) * whole**2 / np.where(spread, spread, 1.0)
    return np.sqrt(whole / (trainings * scenes)), np.maximum(freedom, min(trainings, scenes) - 1)


def paired_interval(differences: np.ndarray) -> tuple[float, float] | None:
    """Return the percentile bootstrap interval of the mean of differences (S,), one per scene.

    The resamples are seeded, so that equal numbers give equal intervals. None for fewer than two
    scenes.
    """
    count = len(differences)
    if count < 2:
        return None
    found = bootstrap(
        (differences,),
        np.mean,
        n_resamples=RESAMPLES,
        # In parts, because 10,000 resamples of many scenes would fill memory.
        batch=max(_AT_A_TIME // count, 1),
        confidence_level=CONFIDENCE,
        method="percentile",
        rng=SEED,
    )
    low, high = found.confidence_interval
    return float(low), float(high)
