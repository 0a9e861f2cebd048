"""What the runs of a study amount to: means, spread over seeds, differences, verdicts.

An interval takes trainings and scenes as random, both: it is for other seeds and other scenes of
the kind (`qgs.engine.comparison.crossed_interval`). Differences are paired: a seed of a variant is
held against the same seed of the reference, which saw the same data in the same order, and a scene
against the same scene.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from qgs.contracts import Column
from qgs.engine.comparison import CONFIDENCE, CROSSED, crossed_interval, paired_interval
from qgs.engine.results import StoredResults, read_results
from qgs.wording import listed
from qgs_studies.hypotheses import MAIN, Contrast
from qgs_studies.plan import Plan, Run
from qgs_studies.study import Hypothesis

Verdict: TypeAlias = Literal["seen", "contradicted", "undecided"]
Terms: TypeAlias = Mapping[tuple[str, str], int]


@dataclass(frozen=True)
class Estimate:
    """A mean, or a sum of means, over the seeds and scenes that all of its parts have.

    by_seed: means over scenes. low, high: see the module; None without an interval. Of one seed
    the interval covers scenes alone.
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
        return float(np.std(values, ddof=1)) if len(values) > 1 else None

    @property
    def covers(self) -> str:
        """What the interval is over."""
        scenes = f"{self.scenes} scene{'s' * (self.scenes != 1)}"
        if len(self.by_seed) == 1:
            return f"1 seed x {scenes}: says nothing of training"
        return f"{len(self.by_seed)} seeds x {scenes}"


@dataclass(frozen=True)
class Row:
    """One variant by one evaluation. scores: by metric. differences: to the reference, by metric.

    steps: of its runs.
    """

    variant: str
    evaluation: str
    scores: Mapping[str, Estimate]
    differences: Mapping[str, Estimate]
    steps: Sequence[int]


@dataclass(frozen=True)
class Judgement:
    """A hypothesis and what became of it. estimate: left minus right; None without runs."""

    hypothesis: Hypothesis
    metric: str
    estimate: Estimate | None
    verdict: Verdict
    reason: str = ""


class Results:
    """All results in the folder of `plan`. missing: runs that lack some of theirs."""

    def __init__(self, plan: Plan) -> None:
        self.plan, self.metric = plan, plan.study.settings.metric
        self._stored: dict[tuple[str, str], dict[int, StoredResults]] = {}
        for run in plan.runs:
            for name in plan.evaluations:
                if run.judged(name):
                    found = read_results(run.evaluation(name))
                    self._stored.setdefault((run.variant, name), {})[run.seed] = found
        self.missing: list[Run] = [run for run in plan.runs if not plan.done(run)]
        self.columns: dict[str, Column] = {}
        for by_seed in self._stored.values():
            for stored in by_seed.values():
                self.columns = {**stored.columns, **self.columns}

    @property
    def column(self) -> Column:
        """How the study's metric is shown."""
        return self.columns[self.metric]

    def rows(self, evaluation: str = MAIN) -> list[Row]:
        """Variants that have results by `evaluation`, in the order of the study."""
        reference, rows = self.plan.study.settings.reference, []
        for variant in self.plan.recipes:
            by_seed = self._stored.get((variant, evaluation), {})
            if not by_seed:
                continue
            apart: Terms = {(variant, evaluation): 1, (reference, evaluation): -1}
            scores = self._estimates({(variant, evaluation): 1})
            differences = self._estimates(apart) if variant != reference else {}
            steps = sorted({s.step for s in by_seed.values() if s.step is not None})
            rows.append(Row(variant, evaluation, scores, differences, steps))
        return rows

    def judgements(self) -> list[Judgement]:
        """The hypotheses in their order."""
        settings = self.plan.study.settings
        pairs = zip(settings.hypotheses, self.plan.study.contrasts, strict=True)
        return [self._judged(hypothesis, contrast) for hypothesis, contrast in pairs]

    def estimate(self, terms: Terms, metric: str) -> Estimate | None:
        """The sum of means that `terms` weigh; None where they share no seed or no scene."""
        stored = [self._stored.get(term, {}) for term in terms]
        seeds = [s for s in self.plan.study.settings.seeds if all(s in part for part in stored)]
        value = f"model_{metric}"
        every = [part[seed].scenes for part in stored for seed in seeds]
        first = every[0] if every else {}
        scenes = [name for name in first if all(value in part.get(name, ()) for part in every)]
        if not scenes:
            return None
        weights = [*terms.values()]
        values = np.array(
            [
                [
                    sum(
                        weight * part[seed].scenes[scene][value]
                        for weight, part in zip(weights, stored, strict=True)
                    )
                    for scene in scenes
                ]
                for seed in seeds
            ]
        )
        low, high = crossed_interval(values) or paired_interval(values[0]) or (None, None)
        by_seed = dict(zip(seeds, map(float, values.mean(1)), strict=True))
        return Estimate(by_seed, len(scenes), low, high)

    def answer(self) -> str:
        """Whether a variant is better than the reference, and how sure that is; one line."""
        reference, column = self.plan.study.settings.reference, self._known_column()
        if column is None:
            return "Not known yet: no run is finished."
        sign = 1 if column.better == "higher" else -1
        apart = {r.variant: e for r in self.rows() if (e := r.differences.get(self.metric))}
        if not apart:
            return f"Not known yet: {reference} and another variant share no finished seed."
        best = max(apart, key=lambda name: sign * apart[name].mean)
        lead, among = apart[best], f", the best of {len(apart)}," if len(apart) > 1 else ""
        told = f"{column.heading} {self.shown(lead.mean)}{self._sureness(lead, sign)}"
        if len(lead.by_seed) < 2:
            return f"Not known: {best}{among} has {told}."
        if lead.low is None or lead.high is None:
            return f"Not known: {best}{among} has {told}, without an interval."
        low = min(sign * lead.low, sign * lead.high)
        if low > 0:
            return f"Yes: {best}{among} is better than {reference}, {told}."
        worse = [name for name, estimate in apart.items() if self._worse(estimate, sign)]
        if len(worse) == len(apart):
            which = f"all {len(apart)} are worse; the nearest, {best}," if among else f"{best}"
            return f"No: {which} is worse than {reference}, {told}."
        open_ = {name: estimate for name, estimate in apart.items() if name not in worse}
        best = max(open_, key=lambda name: sign * open_[name].mean)
        lead = open_[best]
        told = f"{column.heading} {self.shown(lead.mean)}{self._sureness(lead, sign)}"
        others = f"; {len(worse)} of {len(apart)} variants are worse" if worse else ""
        return f"Undecided: {best} cannot be told from {reference}, {told}{others}."

    def notes(self) -> list[str]:
        """What is to be known beside the table."""
        settings, notes = self.plan.study.settings, []
        estimates = [e for row in self.rows() for e in row.differences.values()]
        if any(len(e.by_seed) > 1 for e in estimates):
            notes.append(
                "intervals: 95 %, of the mean paired difference to the reference over trainings "
                f"and scenes, both random ({CROSSED}); sd: over seeds, of means over scenes"
            )
        if any(len(e.by_seed) == 1 for e in estimates):
            notes.append(
                "one training a side: its interval covers scenes, says nothing of training"
            )
        if len(settings.hypotheses) > 1:
            count = len(settings.hypotheses)
            notes.append(f"each of {count} verdicts is at 95 % on its own, not all together")
        if self.missing:
            told = listed(self.missing)
            notes.append(f"{len(self.missing)} of {len(self.plan.runs)} runs are missing: {told}")
        if (rank := self.rank_correlation()) is not None:
            notes.append(f"rank correlation with the published order (Spearman): {rank:+.2f}")
        for name in self.plan.evaluations:
            stored = [s for (_, n), p in self._stored.items() for s in p.values() if n == name]
            if len({s.protocol.sha256 for s in stored}) > 1:
                where = name or "the recipes' own evaluation"
                notes.append(f"{where}: protocols differ between variants")
            lacking = {scene for s in stored for scene in s.missing}
            if lacking:
                notes.append(f"scenes without a score in some run: {listed(sorted(lacking))}")
        return notes

    def rank_correlation(self) -> float | None:
        """Of our means with the published ones; None for fewer than three variants with both."""
        published = self.plan.study.settings.published
        ours = {r.variant: e.mean for r in self.rows() if (e := r.scores.get(self.metric))}
        names = [name for name in published if name in ours]
        if len(names) < 3:
            return None
        ranks = [_ranks([side[name] for name in names]) for side in (published, ours)]
        return float(np.corrcoef(np.stack(ranks))[0, 1])

    def shown(self, value: float | None, metric: str | None = None, sign: bool = True) -> str:
        """A difference or a mean, one digit finer than evaluations show it."""
        if value is None:
            return "–"
        digits = self.columns[metric or self.metric].digits + 1
        return f"{value:{'+' if sign else ''}.{digits}f}"

    def interval(self, estimate: Estimate | None, metric: str | None = None) -> str:
        """[low, high], a dash without one."""
        if estimate is None or estimate.low is None:
            return "–"
        return f"[{self.shown(estimate.low, metric)}, {self.shown(estimate.high, metric)}]"

    def _known_column(self) -> Column | None:
        return self.columns.get(self.metric)

    def _sureness(self, estimate: Estimate, sign: int) -> str:
        ahead = sum(sign * value > 0 for value in estimate.by_seed.values())
        seeds = f"better in {ahead} of {len(estimate.by_seed)} seeds"
        return f" (95 % interval {self.interval(estimate)}, {estimate.covers}, {seeds})"

    @staticmethod
    def _worse(estimate: Estimate, sign: int) -> bool:
        ends = estimate.low, estimate.high
        return all(end is not None and sign * end < 0 for end in ends)

    def _estimates(self, terms: Terms) -> dict[str, Estimate]:
        found = {metric: self.estimate(terms, metric) for metric in self.columns}
        return {metric: estimate for metric, estimate in found.items() if estimate}

    def _judged(self, hypothesis: Hypothesis, contrast: Contrast) -> Judgement:
        metric = hypothesis.metric or self.metric
        estimate = self.estimate(contrast.terms, metric)
        if estimate is None or estimate.low is None or estimate.high is None:
            return Judgement(hypothesis, metric, estimate, "undecided", "runs are missing")
        if len(estimate.by_seed) < 2:
            return Judgement(hypothesis, metric, estimate, "undecided", "one training a side")
        low, high = sorted((contrast.sign * estimate.low, contrast.sign * estimate.high))
        verdict: Verdict = "seen" if low > 0 else "contradicted" if high < 0 else "undecided"
        reason = "the interval holds 0" if verdict == "undecided" else ""
        return Judgement(hypothesis, metric, estimate, verdict, reason)


def _ranks(values: Sequence[float]) -> np.ndarray:
    """Ranks of values, the mean rank where they are equal."""
    array = np.asarray(values)
    return np.array([(array < v).sum() + ((array == v).sum() - 1) / 2 for v in array])
