"""The numbers of a study: means, spread over seeds, differences, verdicts.

An interval takes trainings and scenes as random, both: it holds for other seeds and other scenes
of the kind (`intervals.crossed_interval`). Differences are paired: a seed of a variant with the
same seed of the reference, which saw the same data in the same order, and a scene with the same
scene.
"""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from typing import TypeAlias

import numpy as np
from scipy.stats import spearmanr

from qgs.contracts import Column
from qgs.metrics.baselines import BASELINES
from qgs.wording import counted
from qgs_research.studies.hypotheses import MAIN
from qgs_research.studies.intervals import CONFIDENCE, interval
from qgs_research.studies.runs import Plan, Run
from qgs_research.studies.stored import StoredResults, read_results, scenes_with
from qgs_research.studies.study import Hypothesis

SEEN, CONTRADICTED, UNDECIDED = "seen", "contradicted", "undecided"
Terms: TypeAlias = Mapping[tuple[str, str], int]

_RANKED = 5
"""Fewest variants for a rank correlation.

Of three, one order in six is the published one by chance; of five, one in 120.
"""


@dataclass(frozen=True)
class Estimate:
    """A mean, or a sum of means, over the seeds and scenes that all of its parts have.

    by_seed: means over scenes. low, high: see the module; None without an interval, as of one
    scene. Of one seed the interval covers scenes alone.
    """

    by_seed: Mapping[int, float]
    scenes: int
    low: float | None
    high: float | None

    @property
    def mean(self) -> float:
        """Over seeds, each once."""
        return float(np.mean([*self.by_seed.values()]))

    @property
    def deviation(self) -> float | None:
        """Standard deviation over seeds; None of one."""
        values = [*self.by_seed.values()]
        # Of a sample: the seeds stand for all that could be drawn.
        return float(np.std(values, ddof=1)) if len(values) > 1 else None

    @property
    def sample(self) -> str:
        """Such as "3 seeds x 32 scenes"."""
        return f"{counted(len(self.by_seed), 'seed')} x {counted(self.scenes, 'scene')}"

    @property
    def too_small(self) -> str:
        """Why the interval says nothing of other trainings and scenes; "" where it does."""
        reasons = {"one training a side": len(self.by_seed), "one scene": self.scenes}
        return " and ".join(reason for reason, count in reasons.items() if count < 2)

    def ahead(self, sign: int) -> str:
        """In how many of the seeds the mean has this sign."""
        return f"{sum(sign * v > 0 for v in self.by_seed.values())} of {len(self.by_seed)}"

    def clear(self, sign: int) -> bool:
        """True if the interval is over trainings and scenes, and all on the side of `sign`."""
        # An interval over scenes alone says nothing of other trainings.
        if self.too_small or self.low is None or self.high is None:
            return False
        return min(sign * self.low, sign * self.high) > 0


@dataclass(frozen=True)
class Judgement:
    """A hypothesis and its verdict. estimate: left minus right; None without runs."""

    hypothesis: Hypothesis
    metric: str
    estimate: Estimate | None
    verdict: str
    reason: str = ""


class Results:
    """All results in the folder of `plan`.

    stored: by variant and evaluation, then by seed. missing: runs that lack some of theirs.
    failed: those of them that failed. columns: of all metrics.
    """

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self.settings = plan.study.settings
        self.metric = self.settings.metric
        self.stored: dict[tuple[str, str], dict[int, StoredResults]] = defaultdict(dict)
        self.columns: dict[str, Column] = {}
        for run, name in product(plan.runs, plan.evaluations):
            if run.evaluated(name):
                # Whole evaluations alone: one that is being written would change the means.
                found = read_results(run.evaluation(name))
                self.stored[run.variant, name][run.seed] = found
                # Variants may have metrics that others lack.
                self.columns = {**found.columns, **self.columns}
        self.missing: list[Run] = [run for run in plan.runs if not plan.done(run)]
        self.failed: list[Run] = [run for run in self.missing if run.failed]

    @property
    def column(self) -> Column:
        """How the study's metric is shown; raises KeyError before a run is finished."""
        return self.columns[self.metric]

    @property
    def sign(self) -> int:
        """1 where more of the study's metric is better, else -1."""
        return 1 if self.column.better == "higher" else -1

    @property
    def shared(self) -> str | None:
        """The first evaluation that judged all of its runs by one protocol; None without one."""
        # In the order of the study, so that the recipes' own comes first.
        return next((n for n in self.plan.evaluations if len(self.protocols(n)) == 1), None)

    def variants(self, evaluation: str = MAIN) -> list[str]:
        """Variants that have results by `evaluation`, in the order of the study."""
        return [name for name in self.plan.recipes if self.stored.get((name, evaluation))]

    def score(self, variant: str, metric: str, evaluation: str = MAIN) -> Estimate | None:
        """The mean of a variant; None where it has no values of the metric."""
        return self.estimate({(variant, evaluation): 1}, metric)

    def difference(
        self,
        variant: str,
        metric: str,
        evaluation: str = MAIN,
        confidence: float = CONFIDENCE,
    ) -> Estimate | None:
        """A variant minus the reference.

        None of the reference itself, and where the two were not judged by one protocol.
        """
        reference = self.settings.reference
        terms = {(variant, evaluation): 1, (reference, evaluation): -1}
        # Numbers of two protocols do not measure the same.
        if variant == reference or self.unlike(terms):
            return None
        return self.estimate(terms, metric, confidence)

    def estimate(
        self, terms: Terms, metric: str, confidence: float = CONFIDENCE
    ) -> Estimate | None:
        """The sum of means that `terms` weigh; None where they share no seed or no scene."""
        parts = [self.stored.get(term, {}) for term in terms]
        seeds = [s for s in self.settings.seeds if all(s in by_seed for by_seed in parts)]
        scenes = scenes_with(metric, [by_seed[s] for by_seed in parts for s in seeds])
        if not scenes:
            return None
        values = np.zeros((len(seeds), len(scenes)))
        for by_seed, weight in zip(parts, terms.values(), strict=True):
            # Paired before any mean is taken: what a seed or a scene adds to all variants cancels.
            values += weight * np.array([by_seed[s].scores(metric, scenes) for s in seeds])
        low, high = interval(values, confidence)
        by_seed = dict(zip(seeds, map(float, values.mean(1)), strict=True))
        return Estimate(by_seed=by_seed, scenes=len(scenes), low=low, high=high)

    def baselines(self, evaluation: str = MAIN) -> dict[str, dict[str, float]]:
        """Means over scenes of what needs no model, by name and metric.

        None where an evaluation has several protocols, which have baselines each.
        """
        if len(self.protocols(evaluation)) != 1:
            return {}
        # Any run will do: baselines see the photos, not the model.
        scenes = self._results_of(evaluation)[0].scenes.values()
        found: dict[str, dict[str, float]] = {}
        for name, metric in product(BASELINES, self.columns):
            value = f"{name}_{metric}"
            if values := [scene[value] for scene in scenes if value in scene]:
                found.setdefault(name, {})[metric] = float(np.mean(values))
        return found

    def judgements(self) -> list[Judgement]:
        """The hypotheses in their order."""
        found = []
        contrasts = self.plan.study.contrasts
        for hypothesis, contrast in zip(self.settings.hypotheses, contrasts, strict=True):
            metric = hypothesis.metric or self.metric
            estimate = self.estimate(contrast.terms, metric)
            verdict = UNDECIDED
            reason = f"no seed and scene with `{metric}` in all its runs"
            if estimate:
                reason = estimate.too_small or "the interval holds 0"
                for sign, word in ((contrast.sign, SEEN), (-contrast.sign, CONTRADICTED)):
                    if estimate.clear(sign):
                        verdict = word
                        reason = ""
                if self.unlike(contrast.terms):
                    reason = ", ".join(filter(None, [reason, "judged by unlike protocols"]))
            found.append(Judgement(hypothesis, metric, estimate, verdict, reason))
        return found

    def rank_correlation(self) -> tuple[float | None, int]:
        """Spearman's, of our means by `shared` with the published ones, and of how many variants.

        None for fewer than five.
        """
        ours: dict[str, float] = {}
        published = self.settings.published
        for variant in published if self.shared is not None else ():
            if score := self.score(variant, self.metric, self.shared or MAIN):
                ours[variant] = score.mean
        if len(ours) < _RANKED:
            return None, len(ours)
        found = spearmanr([published[variant] for variant in ours], [*ours.values()])
        return float(found[0]), len(ours)  # type: ignore[arg-type]  # a named tuple

    def protocols(self, evaluation: str) -> set[str]:
        """Hashes of all protocols by which `evaluation` judged."""
        return {stored.protocol.sha256 for stored in self._results_of(evaluation)}

    def unscored(self, evaluation: str) -> list[str]:
        """Scenes without a score in some run."""
        return sorted({s for stored in self._results_of(evaluation) for s in stored.missing})

    def _results_of(self, evaluation: str) -> list[StoredResults]:
        """The results of all runs by `evaluation`."""
        parts = (part for (_, name), part in self.stored.items() if name == evaluation)
        return [stored for part in parts for stored in part.values()]

    def unlike(self, terms: Terms) -> bool:
        """True if terms of one evaluation weigh numbers of unlike protocols against each other."""
        # Terms of one protocol may cancel: `A@two - B@two < C - D` compares like with like twice.
        sums: dict[tuple[str, str], int] = defaultdict(int)
        for (variant, evaluation), weight in terms.items():
            runs = self.stored.get((variant, evaluation), {}).values()
            hashes = {stored.protocol.sha256 for stored in runs}
            if len(hashes) > 1:
                return True
            for sha256 in hashes:
                sums[evaluation, sha256] += weight
        weighed = [evaluation for (evaluation, _), weight in sums.items() if weight]
        return len(set(weighed)) < len(weighed)

    def shown(self, value: float | None, metric: str | None = None, sign: bool = True) -> str:
        """A difference or a mean, one digit finer than evaluations show it."""
        if value is None:
            return "–"
        # Differences are small against the means that an evaluation prints.
        digits = self.columns[metric or self.metric].digits + 1
        return f"{value:{'+' if sign else ''}.{digits}f}"

    def interval(self, estimate: Estimate | None, metric: str | None = None) -> str:
        """[low, high], a dash without one."""
        if estimate is None or estimate.low is None:
            return "–"
        return f"[{self.shown(estimate.low, metric)}, {self.shown(estimate.high, metric)}]"
