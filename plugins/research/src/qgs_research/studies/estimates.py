"""Means over seeds and scenes, their intervals, and how tables show both.

An interval takes trainings and scenes as random, both: it holds for other seeds and other scenes
of the kind (`intervals.crossed_interval`). Differences are paired: a seed with the same seed of the
reference, which saw the same data in the same order, and a scene with the same scene.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from qgs.contracts import Column
from qgs.wording import counted
from qgs_research.studies.intervals import CONFIDENCE, interval
from qgs_research.studies.stored import StoredResults, scenes_with

Runs: TypeAlias = Mapping[int, StoredResults]
"""Results of the trainings of one model, by seed."""


@dataclass(frozen=True)
class Estimate:
    """A mean, or a sum of means, over the seeds and scenes that all of its parts have.

    values: (S, C) of the seeds and scenes. low, high: see the module; None without an interval, as
    of one scene. Of one seed the interval covers scenes alone.
    """

    seeds: Sequence[int]
    values: np.ndarray
    low: float | None
    high: float | None

    @property
    def mean(self) -> float:
        """The mean over seeds, each once."""
        return float(self.values.mean(1).mean())

    @property
    def by_seed(self) -> dict[int, float]:
        """Means over scenes."""
        return dict(zip(self.seeds, map(float, self.values.mean(1)), strict=True))

    @property
    def deviation(self) -> float | None:
        """Standard deviation over seeds; None of one."""
        # Of a sample: the seeds stand for all that could be drawn.
        return float(self.values.mean(1).std(ddof=1)) if len(self.seeds) > 1 else None

    @property
    def scenes(self) -> int:
        """Number of scenes."""
        return self.values.shape[1]

    @property
    def sample(self) -> str:
        """Size of the sample, such as "3 seeds x 32 scenes"."""
        return f"{counted(len(self.seeds), 'seed')} x {counted(self.scenes, 'scene')}"

    @property
    def too_small(self) -> str:
        """Reason why the interval says nothing of other trainings and scenes; "" where it does."""
        reasons = {"one training a side": len(self.seeds), "one scene": self.scenes}
        return " and ".join(reason for reason, count in reasons.items() if count < 2)

    def clear(self, sign: int) -> bool:
        """Return True if the interval is over trainings and scenes, and all on a side of 0."""
        # An interval over scenes alone says nothing of other trainings.
        if self.too_small or self.low is None or self.high is None:
            return False
        return min(sign * self.low, sign * self.high) > 0

    def record(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "mean": self.mean,
            "sd": self.deviation,
            "by_seed": self.by_seed,
            "scenes": self.scenes,
            "low": self.low,
            "high": self.high,
        }


def estimate(
    parts: Sequence[tuple[Runs, int]], metric: str, confidence: float = CONFIDENCE
) -> Estimate | None:
    """Return the sum of means that `parts` weigh; None where they share no seed or no scene."""
    seeds = [seed for seed in parts[0][0] if all(seed in runs for runs, _ in parts)]
    scenes = scenes_with(metric, [runs[seed] for runs, _ in parts for seed in seeds])
    if not scenes:
        return None
    values = np.zeros((len(seeds), len(scenes)))
    for runs, weight in parts:
        # Paired before any mean is taken: what a seed or a scene adds to all models cancels.
        values += weight * np.array([runs[seed].scores(metric, scenes) for seed in seeds])
    low, high = interval(values, confidence)
    return Estimate(seeds=seeds, values=values, low=low, high=high)


def sign_of(column: Column) -> int:
    """Return 1 where more of a metric is better, else -1."""
    return 1 if column.better == "higher" else -1


def count_better(column: Column, difference: Estimate | None) -> str:
    """Return in how many seeds a difference is better than 0, of one seed in how many scenes."""
    if difference is None:
        return "–"
    # The mean of a single seed would only repeat the sign of the difference.
    means = difference.values.mean(1) if len(difference.seeds) > 1 else difference.values[0]
    return f"{(sign_of(column) * means > 0).sum()} of {len(means)}"


def shown(column: Column, value: float | None, sign: str = "") -> str:
    """Return a value one digit finer than evaluations show it. sign: "+" for differences."""
    # Differences are small against the means that an evaluation prints.
    return "–" if value is None else f"{value:{sign}.{column.digits + 1}f}"


def interval_shown(column: Column, estimate: Estimate | None) -> str:
    """Return "[low, high]", a dash without an interval."""
    if estimate is None or estimate.low is None:
        return "–"
    return f"[{shown(column, estimate.low, '+')}, {shown(column, estimate.high, '+')}]"
