"""Mean scores of models, their differences to a reference model, and baselines."""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import TypeAlias

import numpy as np

from qgs.contracts import Column
from qgs.metrics.baselines import BASELINES
from qgs_research.studies.estimates import CONFIDENCE, Estimate, Runs, interval
from qgs_research.studies.hypotheses import MAIN
from qgs_research.studies.stored import StoredResults, common_scenes

Terms: TypeAlias = Mapping[tuple[str, str], int]
"""Weighted sum of mean scores: the weight of each mean, by (model, evaluation)."""


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
        self,
        model: str,
        metric: str,
        evaluation: str = MAIN,
        confidence: float = CONFIDENCE,
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
        found: dict[str, Estimate] = {}
        for model in self.models(evaluation):
            if apart := self.difference(model, self.metric, evaluation, confidence):
                found[model] = apart
        return found

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
        parts = (runs for (_, of), runs in self.stored.items() if of == evaluation)
        return [result for runs in parts for result in runs.values()]

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
