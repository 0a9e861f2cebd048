"""Summary of scores (an answer, tables and notes), as text, Markdown or JSON."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

from rich import box
from rich.console import Console

from qgs.terminal import print_lines, print_table
from qgs.wording import listed
from qgs_research.studies.scores import Estimate, Scores, interval_shown, shown
from qgs_research.studies.stored import StoredResults
from qgs_research.studies.study import MAIN

Rows: TypeAlias = Sequence[Sequence[str]]
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
        difference = shown(column, apart.mean if apart else None, "+")
        row = [
            model,
            shown(column, score.mean if score else None),
            shown(column, score.deviation if score else None),
            "reference" if model == scores.reference else difference,
            interval_shown(column, apart),
        ]
        if published:
            row.append(shown(column, published.get(model)))
        for name in others:
            other = scores.score(model, name, evaluation)
            row.append(shown(scores.columns[name], other.mean if other else None))
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
