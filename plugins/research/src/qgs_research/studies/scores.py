"""Scores of models: means, differences to a reference, and baselines."""

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
from qgs_research.studies.stored import StoredResults, scenes_with

Terms: TypeAlias = Mapping[tuple[str, str], int]
"""Weights of means, by model and evaluation."""


@dataclass
class Scores:
    """Results by model and evaluation, then by seed. reference: the model to compare others with.

    metric: the metric that decides. across_protocols: True to compare results of two protocols.
    """

    stored: Mapping[tuple[str, str], Runs]
    reference: str
    metric: str
    across_protocols: bool = False

    @cached_property
    def columns(self) -> dict[str, Column]:
        """Format of the values of all metrics, also of those that only some models have."""
        columns: dict[str, Column] = {}
        for runs in self.stored.values():
            for result in runs.values():
                columns = {**result.columns, **columns}
        return columns

    @property
    def column(self) -> Column:
        """Format of the metric that decides; raises KeyError without results."""
        return self.columns[self.metric]

    def models(self, evaluation: str = MAIN) -> list[str]:
        """Return the models that have results of `evaluation`."""
        return [name for (name, of), runs in self.stored.items() if of == evaluation and runs]

    def score(self, model: str, metric: str, evaluation: str = MAIN) -> Estimate | None:
        """Return the mean of a model; None if it has no values of the metric."""
        return self.estimate({(model, evaluation): 1}, metric)

    def difference(
        self,
        model: str,
        metric: str,
        evaluation: str = MAIN,
        confidence: float = CONFIDENCE,
    ) -> Estimate | None:
        """Return the difference of a model minus the reference.

        None for the reference itself, and if the two were evaluated by different protocols.
        """
        terms = {(model, evaluation): 1, (self.reference, evaluation): -1}
        # Values of two protocols do not measure the same.
        if model == self.reference or (self.unlike(terms) and not self.across_protocols):
            return None
        return self.estimate(terms, metric, confidence)

    def differences(
        self, evaluation: str = MAIN, confidence: float = CONFIDENCE
    ) -> dict[str, Estimate]:
        """Return the differences in the metric that decides, for models that have one."""
        found: dict[str, Estimate] = {}
        for model in self.models(evaluation):
            if apart := self.difference(model, self.metric, evaluation, confidence):
                found[model] = apart
        return found

    def estimate(
        self, terms: Terms, metric: str, confidence: float = CONFIDENCE
    ) -> Estimate | None:
        """Return the sum of means with weights `terms`; None without a common seed and scene."""
        parts = [(self.stored.get(term, {}), weight) for term, weight in terms.items()]
        seeds = [seed for seed in parts[0][0] if all(seed in runs for runs, _ in parts)]
        scenes = scenes_with(metric, [runs[seed] for runs, _ in parts for seed in seeds])
        if not scenes:
            return None
        values = np.zeros((len(seeds), len(scenes)))
        for runs, weight in parts:
            # Pairing precedes the means, so that common effects of a seed or scene cancel.
            values += weight * np.array([runs[seed].scores(metric, scenes) for seed in seeds])
        return Estimate(seeds=seeds, values=values, interval=interval(values, confidence))

    def baselines(self, evaluation: str) -> dict[str, dict[str, float]]:
        """Return means over scenes of the baselines, by name and metric.

        The result is empty if an evaluation has several protocols, each with its own baselines.
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
        """Return the hashes of all protocols that `evaluation` used."""
        return {result.protocol.sha256 for result in self.results_of(evaluation)}

    def results_of(self, evaluation: str) -> list[StoredResults]:
        """Return the results of `evaluation` for all runs."""
        parts = (runs for (_, of), runs in self.stored.items() if of == evaluation)
        return [result for runs in parts for result in runs.values()]

    def unlike(self, terms: Terms) -> bool:
        """Return True if the terms combine values of different protocols in one evaluation."""
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
