"""What the runs of a study amount to: means, spread over seeds, differences, verdicts.

An interval takes trainings and scenes as random, both: it is for other seeds and other scenes of
the kind (`crossed_interval`). Differences are paired: a seed of a variant is held against the same
seed of the reference, which saw the same data in the same order, and each scene against itself.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from scipy.stats import spearmanr

from qgs.contracts import Column
from qgs.evaluate.evaluation import SECTIONS
from qgs.metrics.baselines import BASELINES
from qgs.wording import counted, listed
from qgs_research.studies.hypotheses import MAIN
from qgs_research.studies.intervals import CONFIDENCE, CROSSED, crossed_interval, interval
from qgs_research.studies.plan import Plan, Run
from qgs_research.studies.stored import StoredResults, read_results
from qgs_research.studies.study import Hypothesis

SEEN, CONTRADICTED, UNDECIDED = "seen", "contradicted", "undecided"
Terms: TypeAlias = Mapping[tuple[str, str], int]

_RANKED = 5  # fewest variants for which a rank correlation means anything


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
        text = f"{counted(len(self.by_seed), 'seed')} x {counted(self.scenes, 'scene')}"
        silent = ["training"] * (len(self.by_seed) == 1) + ["other scenes"] * (self.scenes == 1)
        return f"{text}: says nothing of {' and '.join(silent)}" if silent else text

    def ahead(self, sign: int) -> str:
        """In how many of the seeds the mean has this sign."""
        return f"{sum(sign * v > 0 for v in self.by_seed.values())} of {len(self.by_seed)}"

    def clear(self, sign: int) -> bool:
        """Whether the interval is over trainings and scenes, and all on the side of `sign`."""
        ends = self.low, self.high
        inside = all(end is not None and sign * end > 0 for end in ends)
        return inside and len(self.by_seed) > 1


@dataclass(frozen=True)
class Row:
    """One variant by one evaluation. seeds: of its runs. scores: by metric. steps: of its runs.

    differences: to the reference, by metric; none of the reference itself, and none where the two
    were not judged by one protocol.
    """

    variant: str
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
    verdict: str
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
        for stored in (stored for part in self._stored.values() for stored in part.values()):
            self.columns = {**stored.columns, **self.columns}

    @property
    def column(self) -> Column:
        """How the study's metric is shown; raises KeyError before a run is finished."""
        return self.columns[self.metric]

    @property
    def sign(self) -> int:
        """1 where more of the study's metric is better, else -1."""
        return 1 if self.column.better == "higher" else -1

    def rows(self, evaluation: str = MAIN) -> list[Row]:
        """Variants that have results by `evaluation`, in the order of the study."""
        rows = []
        for variant in self.plan.recipes:
            by_seed = self._stored.get((variant, evaluation), {})
            if not by_seed:
                continue
            apart = self._apart(variant, evaluation)
            scores, differences = (
                {m: e for m in self.columns if (e := self.estimate(terms, m))}
                for terms in ({(variant, evaluation): 1}, {} if self._unlike(apart) else apart)
            )
            steps = sorted({s.step for s in by_seed.values() if s.step is not None})
            rows.append(Row(variant, sorted(by_seed), scores, differences, steps))
        return rows

    def baselines(self, evaluation: str = MAIN) -> dict[str, dict[str, float]]:
        """Means over scenes of what needs no model, by name and metric.

        None where an evaluation has several protocols, which have baselines each.
        """
        if len(self._protocols(evaluation)) != 1:
            return {}
        scenes = self._judged_by(evaluation)[0].scenes.values()
        found: dict[str, dict[str, float]] = {name: {} for name in BASELINES}
        for name, means in found.items():
            for metric in self.columns:
                values = [s[value] for s in scenes if (value := f"{name}_{metric}") in s]
                means |= {metric: float(np.mean(values))} if values else {}
        return {name: means for name, means in found.items() if means}

    def judgements(self) -> list[Judgement]:
        """The hypotheses in their order."""
        study, found = self.plan.study, list[Judgement]()
        for hypothesis, contrast in zip(study.settings.hypotheses, study.contrasts, strict=True):
            metric, verdict, reasons = hypothesis.metric or self.metric, UNDECIDED, list[str]()
            estimate = self.estimate(contrast.terms, metric)
            if estimate is None:
                reasons = [f"no seed and scene with `{metric}` in all its runs"]
            elif len(estimate.by_seed) < 2 or estimate.scenes < 2:
                few = ["one training a side"] * (len(estimate.by_seed) < 2)
                reasons = [" and ".join(few + ["one scene"] * (estimate.scenes < 2))]
            else:
                if estimate.clear(contrast.sign):
                    verdict = SEEN
                elif estimate.clear(-contrast.sign):
                    verdict = CONTRADICTED
                else:
                    reasons = ["the interval holds 0"]
                reasons += ["judged by unlike protocols"] * self._unlike(contrast.terms)
            found.append(Judgement(hypothesis, metric, estimate, verdict, ", ".join(reasons)))
        return found

    @property
    def shared(self) -> str | None:
        """The first evaluation that judged all of its runs by one protocol; None without one."""
        return next((n for n in self.plan.evaluations if len(self._protocols(n)) == 1), None)

    def estimate(
        self, terms: Terms, metric: str, confidence: float = CONFIDENCE
    ) -> Estimate | None:
        """The sum of means that `terms` weigh; None where they share no seed or no scene."""
        stored, value = [self._stored.get(term, {}) for term in terms], f"model_{metric}"
        seeds = [s for s in self.plan.study.settings.seeds if all(s in part for part in stored)]
        every = [part[seed].scenes for part in stored for seed in seeds]
        first = every[0] if every else {}
        scenes = [name for name in first if all(value in part.get(name, ()) for part in every)]
        if not scenes:
            return None
        values = np.array(
            [
                [
                    sum(
                        weight * part[seed].scenes[scene][value]
                        for part, weight in zip(stored, terms.values(), strict=True)
                    )
                    for scene in scenes
                ]
                for seed in seeds
            ]
        )
        crossed = crossed_interval(values, confidence)
        low, high = crossed or interval(values)
        by_seed = dict(zip(seeds, map(float, values.mean(1)), strict=True))
        return Estimate(by_seed, len(scenes), low, high, confidence if crossed else CONFIDENCE)

    def answer(self) -> str:
        """Whether a variant is better than the reference, and how sure that is; one line."""
        return " ".join([self._answer(), *self._left_out(), *self._below_nearest()])

    def _left_out(self) -> Iterator[str]:
        """How many trainings of each variant failed, and how many runs are missing."""
        for variant in self.plan.recipes:
            runs = [run for run in self.plan.runs if run.variant == variant]
            if why := [run.failed.split(":")[0] for run in runs if run in self.failed]:
                of = f"{len(why)} of {len(runs)} trainings of {variant}"
                yield f"Left out: {of} failed ({listed(dict.fromkeys(why))})."
        if waiting := len(self.missing) - len(self.failed):
            yield f"{waiting} of {len(self.plan.runs)} runs are missing."

    def _below_nearest(self) -> Iterator[str]:
        """Which variants a copy of the nearest input photo beats: their order says little."""
        if self.shared is None or self.metric not in self.columns:
            return
        nearest = self.baselines(self.shared).get("nearest_input", {}).get(self.metric)
        means = {r.variant: r.scores[self.metric].mean for r in self.rows(self.shared) if r.scores}
        worse = [v for v, mean in means.items() if self.column.beats(nearest, mean)]
        if worse:
            value = f"{self.column.heading} {self.shown(nearest, sign=False)}"
            yield f"Worse than the nearest input photo, copied ({value}): {listed(worse)}."

    def _answer(self) -> str:
        """By scores alone, in the first evaluation that judges all by one protocol.

        Who is best of n is better where the interval at 1 - 0.05 / n says so (Bonferroni): chance
        has n tries. That all are worse needs no correction, as each must be (an
        intersection-union test).
        """
        settings = self.plan.study.settings
        if self.metric not in self.columns:
            return "Not known yet: no run is finished."
        if (by := self.shared) is None:
            varied = listed(path for path in settings.differs if path.split(".")[0] in SECTIONS)
            verdicts = Counter(judgement.verdict for judgement in self.judgements())
            counts = ", ".join(f"{number} {verdict}" for verdict, number in verdicts.items())
            return (
                "Not known: no evaluation judges all variants by one protocol, so that their "
                f"numbers are not compared; add one{f' that sets {varied}' if varied else ''} to "
                "the study's `evaluations`."
            ) + (f" Verdicts on its hypotheses: {counts}." if counts else "")
        sign, reference = self.sign, settings.reference
        every = {r.variant: e for r in self.rows(by) if (e := r.differences.get(self.metric))}
        if not every:
            return f"Not known yet: {reference} and another variant share no finished seed."

        def described(lead: Estimate) -> str:
            where = f" in the evaluation `{by}`" if by else ""
            tries = round((1 - CONFIDENCE) / (1 - lead.confidence))
            chosen = f", corrected for the best of {tries}" if tries > 1 else ""
            sure = f"{100 * lead.confidence:.3g} % interval {self.interval(lead)}{chosen}"
            return (
                f"{self.column.heading}{where} {self.shown(lead.mean)} "
                f"({'no interval' if lead.low is None else sure}, {lead.covers}, "
                f"better in {lead.ahead(sign)} seeds)"
            )

        def best_of(names: Iterable[str]) -> str:
            return max(names, key=lambda name: sign * every[name].mean)

        judged = {n: e for n, e in every.items() if e.low is not None and len(e.by_seed) > 1}
        best, count = best_of(judged or every), len(judged or every)
        among = f", the best of {count}," if count > 1 else ""
        if not judged:
            return f"Not known: {best}{among} has {described(every[best])}."
        level = 1 - (1 - CONFIDENCE) / count
        tried = ((n, self.estimate(self._apart(n, by), self.metric, level)) for n in judged)
        sure = {name: estimate for name, estimate in tried if estimate}
        if better := [name for name in sure if sure[name].clear(sign)]:
            among = among if best in better else f", of {count} variants,"
            best = best_of(better)
            return f"Yes: {best}{among} is better than {reference}, {described(sure[best])}."
        worse = [name for name, estimate in judged.items() if estimate.clear(-sign)]
        if len(worse) == count:
            which = f"all {count} are worse; the nearest, {best}," if among else f"{best}"
            return f"No: {which} is worse than {reference}, {described(judged[best])}."
        best = best_of(name for name in judged if name not in worse)
        others = f"; worse, each at 95 %: {listed(worse)}" if worse else ""
        return (
            f"Undecided: {best} cannot be told from {reference}, {described(sure[best])}{others}."
        )

    def notes(self) -> list[str]:
        """What is to be known beside the table."""
        notes, count = list[str](), len(self.plan.study.settings.hypotheses)
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
        if count > 1:
            notes.append(f"each of {count} verdicts is at 95 % on its own, not all together")
        if self.missing:
            of = f"{len(self.missing)} of {len(self.plan.runs)}"
            notes.append(f"{of} runs are missing: {listed(self.missing)}")
        notes += [f"{run} failed: {run.failed}" for run in self.failed]
        rank, of = self.rank_correlation()
        if rank is not None:
            order = f"the published order (Spearman, {of} variants)"
            notes.append(f"rank correlation with {order}: {rank:+.2f}")
        for name in self.plan.evaluations:
            if len(self._protocols(name)) > 1:
                found = [v for v in self.plan.recipes if self._unlike(self._apart(v, name))]
                none = f"; no difference is shown of {listed(found)}" if found else ""
                where = name or "the recipes' own evaluation"
                notes.append(f"{where}: protocols differ between variants{none}")
            if lacking := {scene for s in self._judged_by(name) for scene in s.missing}:
                notes.append(f"scenes without a score in some run: {listed(sorted(lacking))}")
        return notes

    def rank_correlation(self) -> tuple[float | None, int]:
        """Of our means with the published ones, by `shared`; None for fewer than five variants.

        The second is the number of variants that have both.

        Of three, one order in six is the published one by chance; of five, one in 120.
        """
        published, ours = self.plan.study.settings.published, dict[str, float]()
        for row in [] if self.shared is None else self.rows(self.shared):
            if row.variant in published and self.metric in row.scores:
                ours[row.variant] = row.scores[self.metric].mean
        if len(ours) < _RANKED:
            return None, len(ours)
        found = spearmanr([published[variant] for variant in ours], [*ours.values()])
        return float(found[0]), len(ours)  # type: ignore[arg-type]  # a named tuple

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

    def _apart(self, variant: str, evaluation: str) -> Terms:
        """The difference of a variant to the reference; nothing of the reference itself."""
        reference = self.plan.study.settings.reference
        if variant == reference:
            return {}
        return {(variant, evaluation): 1, (reference, evaluation): -1}

    def _judged_by(self, evaluation: str) -> list[StoredResults]:
        """The results of all runs by `evaluation`."""
        parts = (part for (_, name), part in self._stored.items() if name == evaluation)
        return [stored for part in parts for stored in part.values()]

    def _protocols(self, evaluation: str) -> set[str]:
        """Hashes of all protocols by which `evaluation` judged."""
        return {stored.protocol.sha256 for stored in self._judged_by(evaluation)}

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
