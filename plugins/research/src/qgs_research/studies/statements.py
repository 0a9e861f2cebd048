"""What the results of a study say, in short statements."""

from collections import Counter
from collections.abc import Iterable, Iterator

from qgs.evaluate.evaluation import SECTIONS
from qgs.wording import listed
from qgs_research.studies.intervals import CONFIDENCE
from qgs_research.studies.results import Estimate, Results


def answer(results: Results) -> str:
    """Whether a variant is better than the reference, and how sure that is; one line."""
    return " ".join([_verdict(results), *_left_out(results), *_below_nearest(results)])


def _verdict(results: Results) -> str:
    """The verdict by scores alone, in the first evaluation that judges all by one protocol.

    The best of n is better where the interval at 1 - 0.05 / n says so (Bonferroni): chance has n
    tries. That all are worse needs no correction, as each must be (an intersection-union test).
    """
    metric = results.metric
    reference = results.settings.reference
    if metric not in results.columns:
        return "Not known yet: no run is finished."
    evaluation = results.shared
    if evaluation is None:
        return _without_shared_protocol(results)
    found: dict[str, Estimate] = {}
    for variant in results.variants(evaluation):
        if estimate := results.difference(variant, metric, evaluation):
            found[variant] = estimate
    if not found:
        return f"Not known yet: {reference} and another variant share no finished seed."

    def best_of(names: Iterable[str]) -> str:
        return max(names, key=lambda name: results.sign * found[name].mean)

    where = f" (evaluation `{evaluation}`)" if evaluation else ""
    # One training a side cannot tell a better model from a better seed.
    tested = [name for name, estimate in found.items() if not estimate.too_small]
    if not tested:
        best = best_of(found)
        return f"Not known{where}: {_lead(results, best, found[best])}, {found[best].too_small}."
    count = len(tested)
    level = 1 - (1 - CONFIDENCE) / count
    corrected: dict[str, Estimate] = {}
    for name in tested:
        if estimate := results.difference(name, metric, evaluation, level):
            corrected[name] = estimate
    bonferroni = f" (Bonferroni, {count} variants)" if count > 1 else ""
    better = [name for name in tested if corrected[name].clear(results.sign)]
    worse = [name for name in tested if found[name].clear(-results.sign)]
    # Each must be worse, so no correction for the number of tries.
    if len(worse) == count:
        best = best_of(worse)
        every = f"all {count} variants are worse than {reference}; the nearest, " * (count > 1)
        return f"No{where}: {every}{_lead(results, best, found[best])}."
    # Where nothing is better, the best of those that might be.
    best = best_of(better or [name for name in tested if name not in worse])
    word = "Yes" if better else "Undecided"
    text = f"{word}{where}: {_lead(results, best, corrected[best])}{bonferroni}."
    if worse:
        text += f" {len(worse)} of {count} variants {'is' if len(worse) == 1 else 'are'} worse."
    return text


def _lead(results: Results, name: str, estimate: Estimate) -> str:
    """Such as "wider, -0.014 dB, interval [-0.289, +0.260]"."""
    # Metrics without a unit are named.
    unit = results.column.unit or results.column.heading
    text = f"{name}, {results.shown(estimate.mean)} {unit}"
    return text if estimate.low is None else f"{text}, interval {results.interval(estimate)}"


def _without_shared_protocol(results: Results) -> str:
    settings = results.settings
    # What the variants evaluate differently is what an evaluation must set for all.
    varied = listed(path for path in settings.differs if path.split(".")[0] in SECTIONS)
    that_sets = f" that sets {varied}" if varied else ""
    text = (
        "Not known: no evaluation judges all variants by one protocol; add one"
        f"{that_sets} to the study's `evaluations`."
    )
    verdicts = Counter(judgement.verdict for judgement in results.judgements())
    counts = ", ".join(f"{number} {verdict}" for verdict, number in verdicts.items())
    return f"{text} Hypotheses: {counts}." if counts else text


def _left_out(results: Results) -> Iterator[str]:
    """How many trainings of each variant failed, and how many runs are missing."""
    for variant in results.plan.recipes:
        runs = [run for run in results.plan.runs if run.variant == variant]
        # The kind of error: its text differs from run to run.
        reasons = [run.failed.split(":")[0] for run in runs if run in results.failed]
        if reasons:
            why = listed(dict.fromkeys(reasons))
            yield f"Failed: {len(reasons)} of {len(runs)} trainings of {variant} ({why})."
    if waiting := len(results.missing) - len(results.failed):
        yield f"Missing: {waiting} of {len(results.plan.runs)} runs."


def _below_nearest(results: Results) -> Iterator[str]:
    """Which variants a copy of the nearest input photo beats: their order says little."""
    evaluation = results.shared
    metric = results.metric
    if evaluation is None or metric not in results.columns:
        return
    # A model that a copied photo beats has learnt no geometry.
    nearest = results.baselines(evaluation).get("nearest_input", {}).get(metric)
    scores = {
        name: results.score(name, metric, evaluation) for name in results.variants(evaluation)
    }
    means = {name: score.mean for name, score in scores.items() if score}
    worse = [name for name, mean in means.items() if results.column.beats(nearest, mean)]
    if worse:
        value = f"{results.column.heading} {results.shown(nearest, sign=False)}"
        yield f"Worse than a copy of the nearest photo ({value}): {listed(worse)}."


def notes(results: Results) -> list[str]:
    """What is to be known beside the table."""
    metric = results.metric
    # The table of the recipes' own evaluation is what readers see first.
    differences = [results.difference(name, metric) for name in results.variants()]
    estimates = [estimate for estimate in differences if estimate]
    found = []
    if any(len(estimate.by_seed) > 1 for estimate in estimates):
        found.append("intervals: 95 %, over trainings and scenes; sd: over seeds")
    if any(len(estimate.by_seed) == 1 for estimate in estimates):
        found.append("one training a side: its interval covers scenes alone")
    if any(estimate.scenes == 1 for estimate in estimates):
        found.append("one scene is too few for an interval")
    if (count := len(results.settings.hypotheses)) > 1:
        found.append(f"each of {count} verdicts is at 95 % on its own")
    if results.missing:
        found.append(f"missing runs: {listed(results.missing)}")
    found += [f"{run} failed: {run.failed}" for run in results.failed]
    rank, variants = results.rank_correlation()
    # The order of variants can be as published where sizes cannot.
    if rank is not None:
        found.append(
            f"rank correlation with the published order ({variants} variants): {rank:+.2f}"
        )
    for evaluation in results.plan.evaluations:
        if len(results.protocols(evaluation)) > 1:
            where = evaluation or "the recipes' own evaluation"
            alone = [
                name
                for name in results.variants(evaluation)
                if not results.difference(name, metric, evaluation)
            ]
            alone.remove(results.settings.reference)
            none = f"; no difference is shown of {listed(alone)}" if alone else ""
            found.append(f"{where}: protocols differ between variants{none}")
        if unscored := results.unscored(evaluation):
            found.append(f"scenes without a score in some run: {listed(unscored)}")
    return found
