"""The results of a study: verdicts, a one-line answer, and files with all numbers."""

from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

from scipy.stats import spearmanr

from qgs.evaluate.results import as_json
from qgs.files import read_records, write_text
from qgs.wording import listed
from qgs_research.studies.plan import Plan
from qgs_research.studies.scores import CONFIDENCE, Estimate, Scores, interval_shown, shown
from qgs_research.studies.stored import read_results
from qgs_research.studies.study import MAIN, Hypothesis, parsed
from qgs_research.studies.tables import (
    Rows,
    Summary,
    interval_notes,
    table_records,
    table_rows,
    training_notes,
)

_RANKED = 5
"""Least number of variants for a rank correlation.

A random order of three variants equals the published order in 1 of 6 cases; of five variants, in
1 of 120 cases.
"""


class Judgement(NamedTuple):
    """Verdict on a hypothesis.

    verdict: "seen" (the scores support the hypothesis), "contradicted" or "undecided". reason: text
    that explains the verdict; "" if it needs none. estimate: left side of the hypothesis minus its
    right side; None if the runs of the two sides have no scores for a common seed and scene.
    """

    hypothesis: Hypothesis
    metric: str
    estimate: Estimate | None
    verdict: str
    reason: str


class Results(Scores):
    """All finished results of a study.

    missing: runs without results in at least one evaluation. failed: runs of `missing` that stopped
    with an error.
    """

    def __init__(self, plan: Plan) -> None:
        settings = plan.study.settings
        stored = {place: {} for place in plan.recipes}
        for run, evaluation in product(plan.runs, plan.evaluations):
            # Only complete evaluations count: one that is being written would change the means.
            if run.evaluated(evaluation):
                stored[run.variant, evaluation][run.seed] = read_results(run.evaluation(evaluation))
        super().__init__(stored=stored, reference=settings.reference, metric=settings.metric)
        self.plan = plan
        self.settings = settings
        self.missing = [run for run in plan.runs if not plan.done(run)]
        self.failed = [run for run in self.missing if run.failed]

    def judgements(self) -> list[Judgement]:
        """Return the verdicts on all hypotheses, in the order of the study file."""
        return [*map(self._judgement, self.settings.hypotheses)]

    def _judgement(self, hypothesis: Hypothesis) -> Judgement:
        study = self.plan.study
        terms, expected = parsed(hypothesis.claim, study.variants, study.evaluations)
        metric = hypothesis.metric or self.metric
        found = self.estimate(terms, metric)
        verdict = "undecided"
        reasons = [f"its runs share no seed and scene with a score `{metric}`"]
        if found:
            reasons = [found.too_small or "the interval contains 0"]
            for sign, word in ((expected, "seen"), (-expected, "contradicted")):
                if found.clear(sign):
                    verdict = word
                    reasons = []
            if self.unlike(terms):
                reasons.append("evaluated by different protocols")
        return Judgement(hypothesis, metric, found, verdict, ", ".join(reasons))

    def rank_correlation(self) -> float | None:
        """Return Spearman's rank correlation of measured means and published values, by variant.

        The means are from the default evaluation. Returns None if fewer than five variants have
        both values, or if the variants were evaluated by different protocols.
        """
        published = self.settings.published
        scores = {variant: self.score(variant, self.metric) for variant in published}
        ours = {variant: score.mean for variant, score in scores.items() if score}
        if len(ours) < _RANKED or len(self.protocols(MAIN)) > 1:
            return None
        found = spearmanr([published[variant] for variant in ours], [*ours.values()])
        return float(found[0])  # type: ignore[arg-type]  # a named tuple


def write_files(results: Results) -> Path:
    """Write results.json and table.md into the study's folder; return the path of table.md.

    If the whole study is trained again, only the training times in results.json may differ.
    """
    study = results.plan.study
    title = study.settings.title or study.file.stem.replace("_", " ")
    head = "\n\n".join(filter(None, [f"# {title}", study.settings.question]))
    table = results.plan.folder / "table.md"
    write_text(table, f"{head}\n\n{study_summary(results).markdown}")
    write_text(results.plan.folder / "results.json", as_json(record(results)))
    return table


def answer(results: Results) -> str:
    """Return one line that says whether a variant is better than the reference variant."""
    text = _verdict(results)
    if results.failed:
        text += f" Failed: {listed(results.failed)}."
    if waiting := len(results.missing) - len(results.failed):
        text += f" Missing: {waiting} of {len(results.plan.runs)} runs."
    return text


def _verdict(results: Results) -> str:
    """Return a sentence that says whether the best variant is better than the reference.

    The scores are from the first evaluation whose runs were all scored by one protocol. A variant
    is better if the interval of its difference to the reference, at confidence 1 - 0.05 / n for n
    variants, lies on the better side of 0 (Bonferroni correction). "All variants are worse" needs
    no correction, because all n intervals must lie on the worse side of 0 (intersection-union
    test).
    """
    # The order is that of the study, so the recipes' own evaluation comes first.
    shared = [name for name in results.plan.evaluations if len(results.protocols(name)) == 1]
    if not shared:
        return "Not known: variants have different protocols; add an evaluation to `evaluations`."
    evaluation = shared[0]
    found = results.differences(evaluation)
    if not found:
        return f"Not known yet: {results.reference} and another variant share no finished seed."
    # One training per side cannot distinguish a better model from a better seed.
    tested = [name for name, estimate in found.items() if not estimate.too_small]
    sign = 1 if results.column.better == "higher" else -1
    worse = all(found[name].clear(-sign) for name in tested)
    tries = 1 if worse else len(tested)
    judged = results.differences(evaluation, 1 - (1 - CONFIDENCE) / tries)
    better = [name for name in tested if judged[name].clear(sign)]
    word = "No" if worse else "Undecided"
    if better:
        word = "Yes"
    best = max(better or tested or found, key=lambda name: sign * found[name].mean)
    small = f", {found[best].too_small}" if not tested else ""
    if small:
        word = "Not known"
    where = f" (evaluation `{evaluation}`)" if evaluation else ""
    # A metric without a unit is shown with its name.
    unit = results.column.unit or results.column.heading
    value = f"{shown(results.column, found[best].mean, '+')} {unit}"
    interval = interval_shown(results.column, judged[best])
    of = f" (Bonferroni, {tries} variants)" if tries > 1 else ""
    return f"{word}{where}: {best}, {value}, interval {interval}{of}{small}."


def notes(results: Results) -> Iterator[str]:
    """Yield the notes to show below the tables of a study, such as missing runs."""
    # Readers see the table of the recipes' own evaluation first.
    yield from interval_notes(results.differences().values())
    yield from training_notes(results)
    if (count := len(results.settings.hypotheses)) > 1:
        yield f"each of the {count} verdicts has 95 % confidence, not all together"
    if results.missing:
        yield f"missing runs: {listed(results.missing)}"
    yield from (f"{run} failed: {run.failed}" for run in results.failed)
    # Our order of variants can match the published one even if the values cannot.
    if (rank := results.rank_correlation()) is not None:
        yield f"rank correlation with the published values: {rank:+.2f}"
    for evaluation in results.plan.evaluations:
        where = evaluation or "default evaluation"
        if len(results.protocols(evaluation)) > 1:
            yield f"{where}: protocols differ, so differences between them are not shown"
        unscored = {s for result in results.results_of(evaluation) for s in result.missing}
        if unscored:
            yield f"{where}: some runs have no score for {listed(sorted(unscored))}"


def study_summary(results: Results) -> Summary:
    """Return the results of a study as text for readers.

    The tables are the verdicts on hypotheses and one table of scores for each evaluation.
    """
    head = ["hypothesis", "metric", "left - right", "95 % interval", "verdict", "sample", "note"]
    judged = [_hypothesis_row(results, judgement) for judgement in results.judgements()]
    tables: list[tuple[str, Rows]] = [("", [head, *judged])] if judged else []
    others = [name for name in results.columns if name != results.metric]
    for name in results.plan.evaluations:
        if results.models(name):
            rows = table_rows(results, name, results.metric, others, results.settings.published)
            tables.append((name, rows))
    return Summary(answer=answer(results), tables=tables, notes=[*notes(results)])


def _hypothesis_row(results: Results, judgement: Judgement) -> list[str]:
    column = results.columns[judgement.metric]
    estimate = judgement.estimate
    reason = f" ({judgement.reason})" if judgement.reason else ""
    return [
        judgement.hypothesis.claim,
        column.heading,
        shown(column, estimate and estimate.mean, "+"),
        interval_shown(column, estimate),
        judgement.verdict + reason,
        estimate.sample if estimate else "–",
        judgement.hypothesis.note,
    ]


def record(results: Results) -> dict[str, Any]:
    """Return the content of results.json: answer, scores, verdicts, notes and training times."""
    table = [row for name in results.plan.evaluations for row in table_records(results, name)]
    return {
        "answer": answer(results),
        "reference": results.reference,
        "metric": results.metric,
        "table": table,
        "hypotheses": [
            {
                **judgement.hypothesis.model_dump(),
                "metric": judgement.metric,
                "verdict": judgement.verdict,
                "reason": judgement.reason,
                **(judgement.estimate.record() if judgement.estimate else {}),
            }
            for judgement in results.judgements()
        ],
        "notes": [*notes(results)],
        "times": [*_times(results)],
    }


def _times(results: Results) -> Iterator[dict[str, Any]]:
    """Yield a record for every run: variant, seed, number of steps, training time in seconds."""
    for run in results.plan.runs:
        # The clock of training stands still between sessions.
        for last in read_records(run.folder / "history.jsonl")[-1:]:
            times = {name: last[name] for name in ("step", "seconds")}
            yield {"variant": run.variant, "seed": run.seed, **times}
