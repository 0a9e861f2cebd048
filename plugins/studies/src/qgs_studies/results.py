"""What the runs of a study amount to: means, spread over seeds, differences, verdicts.

An interval takes trainings and scenes as random, both: it is for other seeds and other scenes of
the kind (`qgs_studies.intervals.crossed_interval`). Differences are paired: a seed of a variant is
held against the same seed of the reference, which saw the same data in the same order, and a scene
against the same scene.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from scipy.stats import spearmanr

from qgs.contracts import Column
from qgs.engine.evaluation import SECTIONS
from qgs.metrics.baselines import BASELINES
from qgs.wording import listed
from qgs_studies.hypotheses import MAIN, Contrast
from qgs_studies.intervals import CONFIDENCE, CROSSED, crossed_interval, paired_interval
from qgs_studies.plan import Plan, Run
from qgs_studies.stored import StoredResults, read_results
from qgs_studies.study import Hypothesis

Verdict: TypeAlias = Literal["seen", "contradicted", "undecided"]
Terms: TypeAlias = Mapping[tuple[str, str], int]

_RANKED = 5  # variants of which a rank correlation says anything


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
    confidence: float = CONFIDENCE

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
        seeds = len(self.by_seed)
        text = f"{seeds} seed{'s' * (seeds != 1)} x {self.scenes} scene{'s' * (self.scenes != 1)}"
        silent = ["training"] * (seeds == 1) + ["other scenes"] * (self.scenes == 1)
        return f"{text}: says nothing of {' and '.join(silent)}" if silent else text


@dataclass(frozen=True)
class Row:
    """One variant by one evaluation. seeds: of its runs. scores: by metric. steps: of its runs.

    differences: to the reference, by metric; none of the reference itself, and none where the two
    were not judged by one protocol.
    """

    variant: str
    evaluation: str
    seeds: Sequence[int]
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
    """All results in the folder of `plan`.

    missing: runs that lack some of theirs. failed: those of them that failed.
    """

    def __init__(self, plan: Plan) -> None:
        self.plan, self.metric = plan, plan.study.settings.metric
        self._stored: dict[tuple[str, str], dict[int, StoredResults]] = {}
        for run in plan.runs:
            for name in plan.evaluations:
                if run.judged(name):
                    found = read_results(run.evaluation(name))
                    self._stored.setdefault((run.variant, name), {})[run.seed] = found
        self.missing: list[Run] = [run for run in plan.runs if not plan.done(run)]
        self.failed: list[Run] = [run for run in self.missing if run.failed]
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
            apart = self._apart(variant, evaluation)
            scores = self._estimates({(variant, evaluation): 1})
            compared = variant != reference and not self._unlike(apart)
            differences = self._estimates(apart) if compared else {}
            steps = sorted({s.step for s in by_seed.values() if s.step is not None})
            rows.append(Row(variant, evaluation, sorted(by_seed), scores, differences, steps))
        return rows

    def baselines(self, evaluation: str = MAIN) -> dict[str, dict[str, float]]:
        """Means over scenes of what needs no model, by name and metric.

        None where an evaluation has several protocols, which have baselines each.
        """
        parts = [part for (_, name), part in self._stored.items() if name == evaluation]
        if len(self._protocols(evaluation)) != 1:
            return {}
        scenes = next(iter(parts[0].values())).scenes.values()
        found: dict[str, dict[str, float]] = {name: {} for name in BASELINES}
        for name, means in found.items():
            for metric in self.columns:
                values = [s[value] for s in scenes if (value := f"{name}_{metric}") in s]
                means |= {metric: float(np.mean(values))} if values else {}
        return {name: means for name, means in found.items() if means}

    def judgements(self) -> list[Judgement]:
        """The hypotheses in their order."""
        settings = self.plan.study.settings
        pairs = zip(settings.hypotheses, self.plan.study.contrasts, strict=True)
        return [self._judged(hypothesis, contrast) for hypothesis, contrast in pairs]

    @property
    def shared(self) -> str | None:
        """The first evaluation that judged all of its runs by one protocol; None without one."""
        return next((n for n in self.plan.evaluations if len(self._protocols(n)) == 1), None)

    def estimate(
        self, terms: Terms, metric: str, confidence: float = CONFIDENCE
    ) -> Estimate | None:
        """The sum of means that `terms` weigh; None where they share no seed or no scene."""
        seeds, scenes = self._common(terms, metric)
        if not scenes:
            return None
        value = f"model_{metric}"
        weighed = [(self._stored[term], weight) for term, weight in terms.items()]
        values = np.array(
            [
                [
                    sum(w * part[seed].scenes[scene][value] for part, w in weighed)
                    for scene in scenes
                ]
                for seed in seeds
            ]
        )
        crossed = crossed_interval(values, confidence)
        low, high = crossed or paired_interval(values[0]) or (None, None)
        by_seed = dict(zip(seeds, map(float, values.mean(1)), strict=True))
        return Estimate(by_seed, len(scenes), low, high, confidence if crossed else CONFIDENCE)

    def answer(self) -> str:
        """Whether a variant is better than the reference, and how sure that is; one line."""
        return " ".join([self._answer(), *self._left_out(), *self._below_nearest()])

    def _left_out(self) -> Iterator[str]:
        """Of each variant, how many trainings failed: what survives says less; what is missing."""
        for variant in self.plan.recipes:
            runs = [run for run in self.plan.runs if run.variant == variant]
            if why := [run.failed.split(":")[0] for run in runs if run in self.failed]:
                told = listed(dict.fromkeys(why))
                yield f"Left out: {len(why)} of {len(runs)} trainings of {variant} failed ({told})."
        if waiting := len(self.missing) - len(self.failed):
            yield f"{waiting} of {len(self.plan.runs)} runs are missing."

    def _below_nearest(self) -> Iterator[str]:
        """Which variants a copy of the nearest input photo beats: their order says little."""
        by, column = self.shared, self._known_column()
        if by is None or column is None:
            return
        nearest = self.baselines(by).get("nearest_input", {}).get(self.metric)
        scores = {row.variant: row.scores.get(self.metric) for row in self.rows(by)}
        means = {variant: score.mean for variant, score in scores.items() if score}
        worse = [v for v, m in means.items() if nearest and column.best((m, nearest)) != m]
        if worse:
            told = f"{column.heading} {self.shown(nearest, sign=False)}"
            yield f"Worse than the nearest input photo, copied ({told}): {listed(worse)}."

    def _answer(self) -> str:
        """By scores alone.

        By the first evaluation that judges all alike. Who is best of n is better where the
        interval at 1 - 0.05 / n says so (Bonferroni): chance has n tries. That all are worse needs
        no correction, as each must be (an intersection-union test).
        """
        reference, column = self.plan.study.settings.reference, self._known_column()
        if column is None:
            return "Not known yet: no run is finished."
        if (by := self.shared) is None:
            return f"Not known: {self._why_unlike()}.{self._verdicts()}"
        sign = 1 if column.better == "higher" else -1
        apart = {r.variant: e for r in self.rows(by) if (e := r.differences.get(self.metric))}
        if not apart:
            return f"Not known yet: {reference} and another variant share no finished seed."

        def told(lead: Estimate) -> str:
            where = f" in the evaluation `{by}`" if by else ""
            return f"{column.heading}{where} {self.shown(lead.mean)}{self._sureness(lead, sign)}"

        def best_of(names: Iterable[str]) -> str:
            return max(names, key=lambda name: sign * apart[name].mean)

        judged = {n: e for n, e in apart.items() if e.low is not None and len(e.by_seed) > 1}
        best, count = best_of(judged or apart), len(judged or apart)
        among = f", the best of {count}," if count > 1 else ""
        lead = apart[best]
        if not judged:
            return f"Not known: {best}{among} has {told(lead)}."
        apart = judged
        level = 1 - (1 - CONFIDENCE) / count
        tried = ((n, self.estimate(self._apart(n, by), self.metric, level)) for n in apart)
        sure = {name: estimate for name, estimate in tried if estimate}
        if better := [name for name in sure if self._ahead(sure[name], sign)]:
            among = among if best in better else f", of {count} variants,"
            best = best_of(better)
            return f"Yes: {best}{among} is better than {reference}, {told(sure[best])}."
        worse = [name for name, estimate in apart.items() if self._ahead(estimate, -sign)]
        if len(worse) == count:
            which = f"all {count} are worse; the nearest, {best}," if among else f"{best}"
            return f"No: {which} is worse than {reference}, {told(lead)}."
        best = best_of(name for name in apart if name not in worse)
        others = f"; worse, each at 95 %: {listed(worse)}" if worse else ""
        return f"Undecided: {best} cannot be told from {reference}, {told(sure[best])}{others}."

    def _verdicts(self) -> str:
        """How many hypotheses have which verdict, a sentence; "" without any."""
        verdicts = Counter(judgement.verdict for judgement in self.judgements())
        told = ", ".join(f"{number} {verdict}" for verdict, number in verdicts.items())
        return f" Verdicts on its hypotheses: {told}." if told else ""

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
        if any(e.scenes == 1 for e in estimates):
            notes.append("one scene is too few for an interval")
        if len(settings.hypotheses) > 1:
            count = len(settings.hypotheses)
            notes.append(f"each of {count} verdicts is at 95 % on its own, not all together")
        if self.missing:
            told = listed(self.missing)
            notes.append(f"{len(self.missing)} of {len(self.plan.runs)} runs are missing: {told}")
        notes += [f"{run} failed: {run.failed}" for run in self.failed]
        if (rank := self.rank_correlation()) is not None:
            of = f"{len(self._published())} variants"
            notes.append(f"rank correlation with the published order (Spearman, {of}): {rank:+.2f}")
        for name in self.plan.evaluations:
            if len(self._protocols(name)) > 1:
                found = [v for v in self.plan.recipes if self._unlike(self._apart(v, name))]
                told = f"; no difference is shown of {listed(found)}" if found else ""
                where = name or "the recipes' own evaluation"
                notes.append(f"{where}: protocols differ between variants{told}")
            stored = [s for (_, n), p in self._stored.items() for s in p.values() if n == name]
            lacking = {scene for s in stored for scene in s.missing}
            if lacking:
                notes.append(f"scenes without a score in some run: {listed(sorted(lacking))}")
        return notes

    def rank_correlation(self) -> float | None:
        """Of our means with the published ones, by `shared`; None for fewer than five variants.

        Of three, one order in six is the published one by chance; of five, one in 120.
        """
        pairs = self._published()
        if len(pairs) < _RANKED:
            return None
        published, ours = zip(*pairs, strict=True)
        return float(spearmanr(published, ours)[0])  # type: ignore[arg-type]  # a named tuple

    def _published(self) -> list[tuple[float, float]]:
        """Published value and ours, of every variant that has both."""
        published = self.plan.study.settings.published
        rows = [] if self.shared is None else self.rows(self.shared)
        return [
            (published[row.variant], row.scores[self.metric].mean)
            for row in rows
            if row.variant in published and self.metric in row.scores
        ]

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
        interval = f"{100 * estimate.confidence:.3g} % interval {self.interval(estimate)}"
        tries = round((1 - CONFIDENCE) / (1 - estimate.confidence))
        chosen = f", corrected for the best of {tries}" if tries > 1 else ""
        told = "no interval" if estimate.low is None else f"{interval}{chosen}"
        return f" ({told}, {estimate.covers}, {seeds})"

    @staticmethod
    def _ahead(estimate: Estimate, sign: int) -> bool:
        """Whether the interval is over trainings and scenes, and all on the side of `sign`."""
        ends = estimate.low, estimate.high
        inside = all(end is not None and sign * end > 0 for end in ends)
        return inside and len(estimate.by_seed) > 1

    def _apart(self, variant: str, evaluation: str) -> Terms:
        """The difference of a variant to the reference; nothing of the reference itself."""
        reference = self.plan.study.settings.reference
        if variant == reference:
            return {}
        return {(variant, evaluation): 1, (reference, evaluation): -1}

    def _protocols(self, evaluation: str) -> set[str]:
        """Hashes of all protocols by which `evaluation` judged."""
        parts = [part for (_, name), part in self._stored.items() if name == evaluation]
        return {stored.protocol.sha256 for part in parts for stored in part.values()}

    def _unlike(self, terms: Terms) -> bool:
        """Whether terms of one evaluation weigh numbers of unlike protocols against each other."""
        sums: dict[tuple[str, frozenset[str]], int] = {}
        for (variant, evaluation), weight in terms.items():
            stored = self._stored.get((variant, evaluation), {}).values()
            key = evaluation, frozenset(s.protocol.sha256 for s in stored)
            sums[key] = sums.get(key, 0) + weight
        several = [hashes for _, hashes in sums if len(hashes) > 1]
        names = [evaluation for (evaluation, hashes), weight in sums.items() if weight and hashes]
        return bool(several) or len(set(names)) < len(names)

    def _why_unlike(self) -> str:
        differs = self.plan.study.settings.differs
        told = listed(path for path in differs if path.split(".")[0] in SECTIONS)
        fix = f" that sets {told}" if told else ""
        return (
            "no evaluation judges all variants by one protocol, so that their numbers are not "
            f"compared; add one{fix} to the study's `evaluations`"
        )

    def _common(self, terms: Terms, metric: str) -> tuple[list[int], list[str]]:
        """Seeds that all `terms` have, and the scenes that have the metric in all of these runs."""
        stored = [self._stored.get(term, {}) for term in terms]
        seeds = [s for s in self.plan.study.settings.seeds if all(s in part for part in stored)]
        every = [part[seed].scenes for part in stored for seed in seeds]
        first, value = every[0] if every else {}, f"model_{metric}"
        return seeds, [n for n in first if all(value in part.get(n, ()) for part in every)]

    def _estimates(self, terms: Terms) -> dict[str, Estimate]:
        found = {metric: self.estimate(terms, metric) for metric in self.columns}
        return {metric: estimate for metric, estimate in found.items() if estimate}

    def _judged(self, hypothesis: Hypothesis, contrast: Contrast) -> Judgement:
        metric = hypothesis.metric or self.metric
        estimate = self.estimate(contrast.terms, metric)
        if estimate is None or (lacking := self._lacking(estimate)):
            reason = self._why_none(contrast.terms, metric) if estimate is None else lacking
            return Judgement(hypothesis, metric, estimate, "undecided", reason)
        verdict: Verdict = "undecided"
        if self._ahead(estimate, contrast.sign):
            verdict = "seen"
        elif self._ahead(estimate, -contrast.sign):
            verdict = "contradicted"
        reasons = ["the interval holds 0"] * (verdict == "undecided")
        reasons += ["judged by unlike protocols"] * self._unlike(contrast.terms)
        return Judgement(hypothesis, metric, estimate, verdict, ", ".join(reasons))

    @staticmethod
    def _lacking(estimate: Estimate) -> str:
        """Why there is no verdict on an estimate however clear it is; empty where there is one."""
        lacking = ["one training a side"] * (len(estimate.by_seed) < 2)
        return " and ".join([*lacking, *["one scene"] * (estimate.scenes < 2)])

    def _why_none(self, terms: Terms, metric: str) -> str:
        seeds, _ = self._common(terms, metric)
        if not seeds:
            return "no seed of which all its runs are finished"
        if metric not in self.columns:
            return f"the runs did not measure `{metric}`"
        return f"no scene has `{metric}` in all its runs"
