"""The results of a study: scores of its runs, verdicts on its hypotheses."""

from dataclasses import dataclass
from itertools import product

from scipy.stats import spearmanr

from qgs_research.studies.estimates import Estimate
from qgs_research.studies.hypotheses import MAIN, Contrast
from qgs_research.studies.runs import Plan
from qgs_research.studies.scores import Scores
from qgs_research.studies.stored import read_results
from qgs_research.studies.study import Hypothesis

SEEN = "seen"
CONTRADICTED = "contradicted"
UNDECIDED = "undecided"

_RANKED = 5
"""Fewest variants for a rank correlation.

Of three, one order in six is the published one by chance; of five, one in 120.
"""


@dataclass(frozen=True)
class Judgement:
    """A hypothesis and its verdict. estimate: left minus right; None without runs."""

    hypothesis: Hypothesis
    metric: str
    estimate: Estimate | None
    verdict: str
    reason: str


class Results(Scores):
    """All results in the folder of `plan`.

    missing: runs that lack some of theirs. failed: those of them that failed.
    """

    def __init__(self, plan: Plan) -> None:
        settings = plan.study.settings
        stored = {place: {} for place in product(plan.recipes, plan.evaluations)}
        for run, evaluation in product(plan.runs, plan.evaluations):
            # Whole evaluations alone: one that is being written would change the means.
            if run.evaluated(evaluation):
                found = read_results(run.evaluation(evaluation))
                stored[run.variant, evaluation][run.seed] = found
        super().__init__(stored=stored, reference=settings.reference, metric=settings.metric)
        self.plan = plan
        self.settings = settings
        self.missing = [run for run in plan.runs if not plan.done(run)]
        self.failed = [run for run in self.missing if run.failed]

    @property
    def shared(self) -> str | None:
        """The first evaluation that judged all of its runs by one protocol; None without one."""
        # In the order of the study, so that the recipes' own comes first.
        return next((n for n in self.plan.evaluations if len(self.protocols(n)) == 1), None)

    def judgements(self) -> list[Judgement]:
        """Return the hypotheses, judged, in their order."""
        pairs = zip(self.settings.hypotheses, self.plan.study.contrasts, strict=True)
        return [self._judgement(hypothesis, contrast) for hypothesis, contrast in pairs]

    def _judgement(self, hypothesis: Hypothesis, contrast: Contrast) -> Judgement:
        metric = hypothesis.metric or self.metric
        found = self.estimate(contrast.terms, metric)
        verdict = UNDECIDED
        reasons = [f"no seed and scene with `{metric}` in all its runs"]
        if found:
            reasons = [found.too_small or "the interval holds 0"]
            for sign, word in ((contrast.sign, SEEN), (-contrast.sign, CONTRADICTED)):
                if found.clear(sign):
                    verdict = word
                    reasons = []
            if self.unlike(contrast.terms):
                reasons.append("judged by unlike protocols")
        return Judgement(
            hypothesis=hypothesis,
            metric=metric,
            estimate=found,
            verdict=verdict,
            reason=", ".join(reasons),
        )

    def rank_correlation(self) -> float | None:
        """Return Spearman's, of our means by the recipes' own evaluation with the published ones.

        None for fewer than five variants, or those of unlike protocols.
        """
        published = self.settings.published
        scores = {variant: self.score(variant, self.metric) for variant in published}
        ours = {variant: score.mean for variant, score in scores.items() if score}
        if len(ours) < _RANKED or len(self.protocols(MAIN)) > 1:
            return None
        found = spearmanr([published[variant] for variant in ours], [*ours.values()])
        return float(found[0])  # type: ignore[arg-type]  # a named tuple
