"""What the results of a study say, in short statements."""

from collections import Counter
from collections.abc import Iterator, Mapping

from qgs.wording import listed
from qgs_research.studies.estimates import Estimate, interval_shown, shown, sign_of
from qgs_research.studies.intervals import CONFIDENCE
from qgs_research.studies.results import Results
from qgs_research.studies.tables import interval_notes


def answer(results: Results) -> str:
    """Return in one line if a variant is better than the reference, and how sure that is."""
    if results.metric not in results.columns:
        return " ".join(["Not known yet: no run is finished.", *_left_out(results)])
    return " ".join([_verdict(results), *_left_out(results), *_below_nearest(results)])


def _verdict(results: Results) -> str:
    """Return the verdict by scores alone, of the first evaluation by one protocol.

    The best of n is better where the interval at 1 - 0.05 / n says so (Bonferroni): chance has n
    tries. That all are worse needs no correction, as each must be (an intersection-union test).
    """
    evaluation = results.shared
    if evaluation is None:
        return _without_shared_protocol(results)
    found = results.differences(evaluation)
    if not found:
        return f"Not known yet: {results.reference} and another variant share no finished seed."
    where = f" (evaluation `{evaluation}`)" if evaluation else ""
    # One training a side cannot tell a better model from a better seed.
    tested = {name: estimate for name, estimate in found.items() if not estimate.too_small}
    if not tested:
        small = next(iter(found.values())).too_small
        return f"Not known{where}: {_best_of(results, found)}, {small}."
    sign = sign_of(results.column)
    count = len(tested)
    worse = [name for name, estimate in tested.items() if estimate.clear(-sign)]
    if len(worse) == count:
        every = f"all {count} variants are worse than {results.reference}; the nearest, "
        return f"No{where}: {every * (count > 1)}{_best_of(results, tested)}."
    corrected = results.differences(evaluation, 1 - (1 - CONFIDENCE) / count)
    better = {name: corrected[name] for name in tested if corrected[name].clear(sign)}
    # Where nothing is better, the best of those that might be.
    possible = {name: corrected[name] for name in tested if name not in worse}
    bonferroni = f" (Bonferroni, {count} variants)" if count > 1 else ""
    word = "Yes" if better else "Undecided"
    text = f"{word}{where}: {_best_of(results, better or possible)}{bonferroni}."
    if worse:
        text += f" {len(worse)} of {count} variants {'is' if len(worse) == 1 else 'are'} worse."
    return text


def _best_of(results: Results, found: Mapping[str, Estimate]) -> str:
    """Return the best, such as "wider, -0.014 dB, interval [-0.289, +0.260]"."""
    column = results.column
    name = max(found, key=lambda name: sign_of(column) * found[name].mean)
    # Metrics without a unit are named.
    text = f"{name}, {shown(column, found[name].mean, '+')} {column.unit or column.heading}"
    interval = interval_shown(column, found[name])
    return text if found[name].low is None else f"{text}, interval {interval}"


def _without_shared_protocol(results: Results) -> str:
    text = (
        "Not known: no evaluation judges all variants by one protocol; add one that sets what "
        "differs to the study's `evaluations`."
    )
    verdicts = Counter(judgement.verdict for judgement in results.judgements())
    counts = ", ".join(f"{number} {verdict}" for verdict, number in verdicts.items())
    return f"{text} Hypotheses: {counts}." if counts else text


def _left_out(results: Results) -> Iterator[str]:
    """Yield how many trainings of each variant failed, and how many runs are missing."""
    runs = results.plan.runs
    every = Counter(run.variant for run in runs)
    for variant, count in Counter(run.variant for run in results.failed).items():
        # The kind of error: its text differs from run to run.
        reasons = {r.failed.split(":")[0]: r for r in results.failed if r.variant == variant}
        yield f"Failed: {count} of {every[variant]} trainings of {variant} ({listed(reasons)})."
    if waiting := len(results.missing) - len(results.failed):
        yield f"Missing: {waiting} of {len(runs)} runs."


def _below_nearest(results: Results) -> Iterator[str]:
    """Yield which variants a copy of the nearest input photo beats."""
    evaluation = results.shared
    if evaluation is None:
        return
    # A model that a copied photo beats has learnt no geometry: their order says little.
    nearest = results.baselines(evaluation).get("nearest_input", {}).get(results.metric)
    worse: list[str] = []
    for name in results.models(evaluation):
        score = results.score(name, results.metric, evaluation)
        if score and results.column.beats(nearest, score.mean):
            worse.append(name)
    if worse:
        value = f"{results.column.heading} {shown(results.column, nearest)}"
        yield f"Worse than a copy of the nearest photo ({value}): {listed(worse)}."


def notes(results: Results) -> list[str]:
    """Return what is to be known beside the table."""
    # The table of the recipes' own evaluation is what readers see first.
    found = [*interval_notes([*results.differences().values()])]
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
            known = {results.reference, *results.differences(evaluation)}
            alone = [name for name in results.models(evaluation) if name not in known]
            none = f"; no difference is shown of {listed(alone)}" if alone else ""
            found.append(f"{where}: protocols differ between variants{none}")
        unscored = {s for result in results.results_of(evaluation) for s in result.missing}
        if unscored:
            found.append(f"scenes without a score in some run: {listed(sorted(unscored))}")
    return found
