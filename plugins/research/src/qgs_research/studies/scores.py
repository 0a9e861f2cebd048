"""Mean scores of models over seeds and scenes, differences, baselines, and confidence intervals.

Intervals treat both trainings and scenes as random samples, so they hold for new seeds and new
scenes of the same kind; see `interval`. Differences are paired by seed and by scene, because
trainings with the same seed saw the same data in the same order.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
from scipy.stats import bootstrap
from scipy.stats import t as student

from qgs.contracts import Column
from qgs.metrics.baselines import BASELINES
from qgs.wording import counted
from qgs_research.studies.stored import StoredResults, common_scenes
from qgs_research.studies.study import MAIN, Terms

RESAMPLES = 10_000
CONFIDENCE = 0.95
SEED = 0

Runs = Mapping[int, StoredResults]
"""Results of one model, by training seed."""


@dataclass(frozen=True)
class Estimate:
    """Mean score over seeds and scenes, or a weighted sum of such means.

    values: scores (S, C) of S seeds and C scenes. interval: confidence interval of the mean; None
    for one scene. For one seed, the interval covers only variation between scenes, not
    between trainings.
    """

    seeds: Sequence[int]
    values: np.ndarray
    interval: tuple[float, float] | None

    @property
    def mean(self) -> float:
        """Mean over seeds of the means over scenes."""
        return float(self.values.mean(1).mean())

    @property
    def deviation(self) -> float | None:
        """Standard deviation over seeds of the means over scenes; None for one seed."""
        # This is the deviation of a sample, because seeds stand for all possible seeds.
        return float(self.values.mean(1).std(ddof=1)) if len(self.seeds) > 1 else None

    @property
    def scenes(self) -> int:
        """Number of scenes."""
        return self.values.shape[1]

    @property
    def sample(self) -> str:
        """Size of the sample, for example "3 seeds x 32 scenes"."""
        return f"{counted(len(self.seeds), 'seed')} x {counted(self.scenes, 'scene')}"

    @property
    def too_small(self) -> str:
        """Reason why the interval does not hold for new trainings and scenes; "" if it holds."""
        reasons = {"one training per side": len(self.seeds), "one scene": self.scenes}
        return " and ".join(reason for reason, count in reasons.items() if count < 2)

    def clear(self, sign: int) -> bool:
        """Return whether the whole interval has the sign `sign`, 1 or -1.

        Always False for an interval from one training or one scene.
        """
        # An interval over scenes alone does not hold for other trainings.
        ends = () if self.too_small else self.interval or ()
        return min((sign * end for end in ends), default=0.0) > 0

    def record(self) -> dict[str, Any]:
        """Return the estimate as plain values for JSON; `by_seed` has the means over scenes."""
        return {
            "mean": self.mean,
            "sd": self.deviation,
            "by_seed": dict(zip(self.seeds, self.values.mean(1).tolist(), strict=True)),
            "scenes": self.scenes,
            "interval": self.interval,
        }


def shown(column: Column, value: float | None, sign: str = "") -> str:
    """Format a value with one digit more than `qgs eval` shows; None as a dash.

    sign: "+" writes the sign of positive values too, for differences.
    """
    # Differences are small compared with the means that an evaluation prints.
    return "–" if value is None else f"{value:{sign}.{column.digits + 1}f}"


def interval_shown(column: Column, estimate: Estimate | None) -> str:
    """Format an interval as "[low, high]", or as a dash if there is none."""
    if estimate is None or estimate.interval is None:
        return "–"
    return f"[{', '.join(shown(column, end, '+') for end in estimate.interval)}]"


def interval(values: np.ndarray, confidence: float = CONFIDENCE) -> tuple[float, float] | None:
    """Return a confidence interval of the mean of `values` (S, C): S trainings, C scenes.

    Trainings and scenes count as random samples, so the interval holds for new trainings and
    scenes; see `crossed_error`. For one training, the interval is a 95 % percentile bootstrap over
    scenes only, with a fixed random seed. Returns None for one scene.
    """
    trainings, scenes = values.shape
    if scenes < 2:
        return None
    if trainings > 1:
        error, freedom = crossed_error(values)
        half = float(student.ppf((1 + confidence) / 2, freedom) * error)
        return float(values.mean() - half), float(values.mean() + half)
    found = bootstrap(
        values,
        np.mean,
        n_resamples=RESAMPLES,
        # Resample in parts, because 10,000 resamples of many scenes would fill the memory.
        batch=100,
        confidence_level=CONFIDENCE,
        method="percentile",
        rng=SEED,
    )
    low, high = found.confidence_interval
    return float(low), float(high)


def crossed_error(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the standard error of the means of `values` (..., S, C), and its degrees of freedom.

    Both results are (...). S is the number of trainings, C the number of scenes. The variance is a
    sum of mean squares, as in two-way analysis of variance. Its degrees of freedom follow
    Satterthwaite 1946 (doi.org/10.2307/3002019), but are at least min(S, C) - 1. Degrees of
    freedom without the variance of the scenes (Hillis 2007, doi.org/10.1002/sim.2532) give
    intervals that are too narrow for few trainings.
    """
    *_, trainings, scenes = values.shape
    of_training = values.mean(-1, keepdims=True)
    of_scene = values.mean(-2, keepdims=True)
    # This is the interaction, and also the noise of a single score.
    rest = values - of_training - of_scene + values.mean((-2, -1), keepdims=True)
    noise = (rest**2).sum((-2, -1)) / ((trainings - 1) * (scenes - 1))
    first = scenes * of_training.var((-2, -1), ddof=1)
    second = trainings * of_scene.var((-2, -1), ddof=1)
    # Otherwise the scenes add no variance, and the difference would be negative.
    own = second > noise
    whole = first + own * (second - noise)
    spread = first**2 + own * (second**2 * (trainings - 1) + noise**2) / (scenes - 1)
    freedom = (trainings - 1) * whole**2 / np.where(spread, spread, 1.0)
    return np.sqrt(whole / (trainings * scenes)), np.maximum(freedom, min(trainings, scenes) - 1)


@dataclass
class Scores:
    """Stored results of several models, with their means and differences.

    stored: results by (model, evaluation), then by seed. reference: model with which the other
    models are compared. metric: metric that decides which model is better. across_protocols: True
    allows differences between results of different evaluation protocols.
    """

    stored: Mapping[tuple[str, str], Runs]
    reference: str
    metric: str
    across_protocols: bool = False

    @cached_property
    def columns(self) -> dict[str, Column]:
        """Table formats of all metrics that at least one model has, by name of the metric."""
        columns: dict[str, Column] = {}
        for runs in self.stored.values():
            for result in runs.values():
                # formats of the first result win, so that one metric has one format
                columns = {**result.columns, **columns}
        return columns

    @property
    def column(self) -> Column:
        """Table format of `self.metric`. Raises KeyError if no result has this metric."""
        return self.columns[self.metric]

    def models(self, evaluation: str = MAIN) -> list[str]:
        """Return the names of all models with results of `evaluation`."""
        return [name for (name, of), runs in self.stored.items() if of == evaluation and runs]

    def score(self, model: str, metric: str, evaluation: str = MAIN) -> Estimate | None:
        """Return the mean score of a model; None if the model has no values of the metric."""
        return self.estimate({(model, evaluation): 1}, metric)

    def difference(
        self, model: str, metric: str, evaluation: str = MAIN, confidence: float = CONFIDENCE
    ) -> Estimate | None:
        """Return the mean score of a model minus that of the reference model.

        Returns None for the reference itself, and if the two models were evaluated by different
        protocols and `across_protocols` is False.
        """
        terms = {(model, evaluation): 1, (self.reference, evaluation): -1}
        # Values of two protocols do not measure the same.
        if model == self.reference or (self.unlike(terms) and not self.across_protocols):
            return None
        return self.estimate(terms, metric, confidence)

    def differences(
        self, evaluation: str = MAIN, confidence: float = CONFIDENCE
    ) -> dict[str, Estimate]:
        """Return the differences to the reference model in `self.metric`, by model.

        Models for which `difference` returns None are left out.
        """
        return {
            model: apart
            for model in self.models(evaluation)
            if (apart := self.difference(model, self.metric, evaluation, confidence))
        }

    def estimate(
        self, terms: Terms, metric: str, confidence: float = CONFIDENCE
    ) -> Estimate | None:
        """Return a weighted sum of mean scores over the seeds and scenes that all its terms share.

        Returns None if the terms share no seed or no scene.
        """
        parts = [self.stored.get(term, {}) for term in terms]
        seeds = [seed for seed in parts[0] if all(seed in runs for runs in parts)]
        results = [runs[seed] for runs in parts for seed in seeds]
        # scenes.csv has the baselines' values too.
        value = f"model_{metric}"
        both = common_scenes(results)
        scenes = [scene for scene in both if all(value in one.scenes[scene] for one in results)]
        if not scenes:
            return None
        scores = np.array([[one.scenes[scene][value] for scene in scenes] for one in results])
        weights = np.array([*terms.values()])[:, None, None]
        # Pairing precedes the means, so that common effects of a seed or scene cancel.
        values = (weights * scores.reshape(len(parts), len(seeds), -1)).sum(0)
        return Estimate(seeds=seeds, values=values, interval=interval(values, confidence))

    def baselines(self, evaluation: str) -> dict[str, dict[str, float]]:
        """Return the mean scores of the baselines, by name of the baseline, then by metric.

        The result is empty if the results of `evaluation` have different protocols, because each
        protocol has its own baselines.
        """
        if len(self.protocols(evaluation)) != 1:
            return {}
        # Any run is enough, because baselines do not depend on the model.
        scenes = self.results_of(evaluation)[0].scenes.values()
        found: dict[str, dict[str, float]] = defaultdict(dict)
        for name, metric in product(BASELINES, self.columns):
            value = f"{name}_{metric}"
            if values := [scene[value] for scene in scenes if value in scene]:
                found[name][metric] = float(np.mean(values))
        return found

    def protocols(self, evaluation: str) -> set[str]:
        """Return the SHA-256 hashes of all protocols in the results of `evaluation`."""
        return {result.protocol.sha256 for result in self.results_of(evaluation)}

    def results_of(self, evaluation: str) -> list[StoredResults]:
        """Return all results of `evaluation` in one list: every model with every seed."""
        models = self.models(evaluation)
        return [result for name in models for result in self.stored[name, evaluation].values()]

    def unlike(self, terms: Terms) -> bool:
        """Return True if `terms` compares results of the same evaluation under different protocols.

        terms: weights of mean scores in a sum, such as 1 and -1 for a difference.
        """
        # Each evaluation may have its own protocol: `A@two - B@two < C - D` is a valid comparison.
        sums: dict[tuple[str, str], int] = defaultdict(int)
        for (model, evaluation), weight in terms.items():
            runs = self.stored.get((model, evaluation), {}).values()
            hashes = {result.protocol.sha256 for result in runs}
            if len(hashes) > 1:
                return True
            for sha256 in hashes:
                sums[evaluation, sha256] += weight
        weighed = [evaluation for (evaluation, _), weight in sums.items() if weight]
        return len(set(weighed)) < len(weighed)
