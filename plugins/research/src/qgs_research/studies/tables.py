"""Summary of scores (an answer, tables and notes), as text, Markdown or JSON, and `qgs compare`.

In a comparison, the first result is the reference. Trainings of one recipe with several seeds are
compared as one model. Intervals then account for the differences between trainings as well as
between scenes.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rich import box
from rich.console import Console

from qgs.terminal import print_lines, print_table
from qgs.wording import listed
from qgs_research.studies.scores import Estimate, Runs, Scores, interval_shown, shown
from qgs_research.studies.stored import StoredResults, common_scenes, moved_scenes
from qgs_research.studies.study import MAIN

Rows = Sequence[Sequence[str]]
"""Rows of a table, as lists of cells. The first row has the headers."""


@dataclass(frozen=True)
class Summary:
    """Results of a comparison for readers: an answer, tables and notes.

    answer: one line; "" if there is none. tables: pairs of title and rows. notes: lines below the
    tables.
    """

    answer: str
    tables: Sequence[tuple[str, Rows]]
    notes: Sequence[str]

    def show(self, console: Console) -> None:
        """Print the answer, the tables and the notes to `console`."""
        print_lines(console, filter(None, [self.answer]))
        for title, rows in self.tables:
            print_table(
                console, title, rows, box=box.SIMPLE_HEAD, collapse_padding=True, pad_edge=False
            )
        print_lines(console, self.notes)

    @property
    def markdown(self) -> str:
        """The answer, the tables and the notes as Markdown."""
        parts = [self.answer]
        for title, rows in self.tables:
            parts += [f"**{title}**" if title else "", markdown_table(rows)]
        notes = "\n".join(f"- {note}" for note in self.notes)
        return "\n\n".join(filter(None, [*parts, notes])) + "\n"


def markdown_table(rows: Rows) -> str:
    """Return a Markdown table with all columns but the first aligned to the right."""
    rule = [":---", *["---:"] * (len(rows[0]) - 1)]
    lines = [[cell.replace("|", "\\|") for cell in row] for row in (rows[0], rule, *rows[1:])]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def table_rows(
    scores: Scores,
    evaluation: str,
    metric: str,
    others: Sequence[str] = (),
    published: Mapping[str, float] | None = None,
) -> Rows:
    """Return a table of scores, with one row for each model and each baseline.

    metric: the table shows its mean, standard deviation and difference to the reference model, and
    the interval of this difference. others: metrics of which the table shows only means.
    published: published values of `metric`, by model.
    """
    column = scores.columns[metric]
    head = [column.title, "sd", "difference", "95 % interval"]
    head += ["published"] if published else []
    head += [scores.columns[name].title for name in others]
    rows = [["variant", *head, "seeds", "steps"]]
    for model in scores.models(evaluation):
        score = scores.score(model, metric, evaluation)
        apart = scores.difference(model, metric, evaluation)
        difference = shown(column, apart and apart.mean, "+")
        row = [
            model,
            shown(column, score and score.mean),
            shown(column, score and score.deviation),
            "reference" if model == scores.reference else difference,
            interval_shown(column, apart),
        ]
        if published:
            row.append(shown(column, published.get(model)))
        for name in others:
            other = scores.score(model, name, evaluation)
            row.append(shown(scores.columns[name], other and other.mean))
        runs = scores.stored[model, evaluation].values()
        rows.append([*row, str(len(runs)), steps_shown(runs)])
    # Baselines come after the models, because they were not trained.
    for name, values in scores.baselines(evaluation).items():
        first, *rest = [shown(scores.columns[m], values.get(m)) for m in (metric, *others)]
        dashes = ["–"] * (len(head) - 1 - len(rest))
        rows.append([name.replace("_", " "), first, *dashes, *rest, "–", "–"])
    return rows


def steps_shown(runs: Iterable[StoredResults]) -> str:
    """Return the number of training steps as text: "2,100", or "2,100 to 2,400" if runs differ.

    Returns "–" if no run has a number of steps.
    """
    # Budgets in seconds end at different steps.
    steps = sorted({stored.step for stored in runs if stored.step is not None})
    return " to ".join(f"{step:,}" for step in (*steps[:1], *steps[1:][-1:])) or "–"


def table_records(scores: Scores, evaluation: str = MAIN) -> Iterator[dict[str, Any]]:
    """Yield a JSON record for each model and metric.

    A record has the mean score and the difference to the reference model.
    """
    for model in scores.models(evaluation):
        for metric in scores.columns:
            if score := scores.score(model, metric, evaluation):
                apart = scores.difference(model, metric, evaluation)
                yield {
                    "evaluation": evaluation,
                    "variant": model,
                    "metric": metric,
                    **score.record(),
                    "difference": apart.record() if apart else {},
                    "steps": steps_shown(scores.stored[model, evaluation].values()),
                }


def training_notes(scores: Scores) -> Iterator[str]:
    """Yield a note for each model whose training differs from that of the reference model.

    The data, number of steps, seconds and batch size of the trainings are compared.
    """

    def facts(model: str) -> set[tuple[str, str]]:
        return {fact for run in scores.stored[model, MAIN].values() for fact in run.trained.items()}

    theirs = facts(scores.reference)
    for model in scores.models():
        ours = facts(model)
        # Results without a run folder do not include how the model was trained.
        known = dict(ours).keys() & dict(theirs).keys()
        if unequal := sorted(known & dict(ours ^ theirs).keys()):
            yield f"{model} was trained unlike {scores.reference}: {listed(unequal)} differ"


def interval_notes(differences: Iterable[Estimate]) -> Iterator[str]:
    """Yield notes that say which variation the confidence intervals of `differences` cover.

    With several seeds, an interval covers trainings and scenes; with one seed, only scenes.
    """
    seeds = {len(estimate.seeds) for estimate in differences}
    if max(seeds, default=0) > 1:
        yield "95 % intervals cover trainings and scenes; sd is the standard deviation over seeds"
    if 1 in seeds:
        yield "with one training per model, an interval covers scenes only, not other trainings"


def compare(results: Sequence[StoredResults], across_protocols: bool = False) -> Scores:
    """Return the scores of `results`, grouped by model. The first result's model is the reference.

    Raises ValueError for fewer than two results, for a folder given twice, and if a model has no
    scene in common with the reference. Unless `across_protocols` is True, raises ValueError for
    different protocols or frames.
    """
    names = [result.name for result in results]
    if len(names) < 2 or len(set(names)) < len(names):
        raise ValueError(
            f"a comparison takes two or more different results, got {names}: name each folder once"
        )
    reference, *others = sides = _sides(results)
    for name in others:
        both = [*sides[reference].values(), *sides[name].values()]
        if not common_scenes(both):
            raise ValueError(
                f"{reference} and {name} have no common scene: evaluate both on the same scenes"
            )
        if not across_protocols:
            _refuse_unlike(reference, name, both)
        sides[name] = _paired(sides[reference], sides[name])
    return Scores(
        stored={(name, MAIN): runs for name, runs in sides.items()},
        reference=reference,
        # The first metric of a recipe decides; it is usually PSNR.
        metric=next(iter(results[0].columns)),
        across_protocols=across_protocols,
    )


def _sides(results: Sequence[StoredResults]) -> dict[str, Runs]:
    """Group results by side of the comparison, and then by seed.

    Trainings of one recipe are one side. If all results are of one recipe, each result is a side.
    """
    groups: dict[Any, list[StoredResults]] = {}
    for number, result in enumerate(results):
        # Results without a run folder have no recipe, so each is a side of its own.
        key = (result.recipe, result.protocol.sha256) if result.recipe else number
        groups.setdefault(key, []).append(result)
    sides: dict[str, Runs] = {}
    for group in groups.values():
        by_seed = {run.seed or 0: run for run in group}
        # If there is only one recipe, compare its seeds. The same seed twice is no second training.
        if len(groups) == 1 or len(by_seed) < len(group) or len(group) == 1:
            sides |= {run.name: {run.seed or 0: run} for run in group}
            continue
        sides[f"{group[0].name} x {len(group)} seeds"] = by_seed
    return sides


def _paired(reference: Runs, runs: Runs) -> Runs:
    """Pair `runs` with runs of `reference`; return `runs` by the seeds of their partners.

    Runs with equal seeds are paired if there are at least two such pairs; if `reference` or `runs`
    is a single run, one such pair is enough. Otherwise runs are paired in order.
    """
    # Trainings with equal seeds saw the same data in the same order.
    if len(reference.keys() & runs.keys()) >= min(2, len(reference), len(runs)):
        return runs
    # Runs without a partner get keys that no seed has.
    keys = [*reference, *range(-len(runs), 0)]
    return dict(zip(keys, runs.values(), strict=False))


def _refuse_unlike(reference: str, name: str, results: Sequence[StoredResults]) -> None:
    """Raise ValueError if two sides were evaluated by different protocols or on different frames.

    reference, name: names of the sides. results: those of the first, then those of the second.
    """
    ours = results[0].protocol
    theirs = results[-1].protocol
    if theirs.sha256 != ours.sha256:
        keys = sorted({*ours.content, *theirs.content})
        unequal = [key for key in keys if ours.content.get(key) != theirs.content.get(key)]
        raise ValueError(
            f"{reference} was evaluated by {ours}, {name} by {theirs}; these protocols "
            f"differ in {listed(unequal)}. Evaluate both by one protocol, or compare anyway with "
            "--across-protocols"
        )
    if moved := moved_scenes(results):
        raise ValueError(
            f"{reference} and {name} were evaluated on different frames of {len(moved)} scenes, "
            f"although their protocols agree: {listed(moved)}. The data or the choice of views "
            "changed in between. Evaluate both again, or compare anyway with --across-protocols"
        )


def summary(scores: Scores) -> Summary:
    """Return a table for each metric, and notes below the tables."""
    tables = [("", table_rows(scores, MAIN, metric)) for metric in scores.columns]
    return Summary(answer="", tables=tables, notes=[*_notes(scores)])


def record(scores: Scores) -> dict[str, Any]:
    """Return the content of comparison.json: a record for each model and metric, and notes."""
    return {
        "reference": scores.reference,
        "table": [*table_records(scores)],
        "notes": [*_notes(scores)],
    }


def _notes(scores: Scores) -> Iterator[str]:
    """Yield the notes to show below the tables."""
    yield f"difference: score minus score of {scores.reference}, over common scenes"
    yield from interval_notes(scores.differences().values())
    yield from training_notes(scores)
    for sha256 in sorted(scores.protocols(MAIN)):
        yield f"protocol with sha256 {sha256}"
    for name in scores.models():
        for words, names in _left_out(scores, name).items():
            if names:
                yield f"{name}: {words} ({len(names)}): {listed(sorted(names))}"
    if len(scores.protocols(MAIN)) > 1:
        yield "the protocols differ, so the scores do not measure the same thing"


def _left_out(scores: Scores, name: str) -> dict[str, Collection[str]]:
    """Return names of runs and scenes that the comparison with the reference leaves out, by reason.

    name: the model that is compared with the reference.
    """
    runs = scores.stored[name, MAIN]
    reference = scores.stored[scores.reference, MAIN]
    results = [*reference.values(), *runs.values()]
    unpaired = runs.keys() ^ reference.keys()
    scenes = {scene for result in results for scene in result.scenes}
    return {
        "scenes without a score": results[-1].missing,
        "runs without a partner": [{**reference, **runs}[key].name for key in unpaired],
        "scenes not in both": scenes.difference(common_scenes(results)),
        "scenes with different frames": moved_scenes(results),
    }
