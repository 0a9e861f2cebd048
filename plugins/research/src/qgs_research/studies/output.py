"""The tables of a study, printed, and its files: results.json and table.md."""

from collections.abc import Iterable, Iterator
from dataclasses import asdict
from typing import Any

from rich.console import Console

from qgs.evaluate.results import as_json, bullets, markdown_table, print_lines, print_table
from qgs.files import write_text
from qgs_research.studies.hypotheses import MAIN
from qgs_research.studies.queue import last_record
from qgs_research.studies.results import Estimate, Results
from qgs_research.studies.statements import answer, notes
from qgs_research.studies.stored import COMPACT, StoredResults

Rows = list[list[str]]


def table_rows(results: Results, evaluation: str = MAIN) -> Rows:
    """One table, headers first: the study's metric in full, means of the others."""
    metric = results.metric
    published = results.settings.published
    # The study's metric has five columns, others one each.
    others = [name for name in results.columns if name != metric]
    head = ["variant", results.column.title, "sd", "difference", "95 % interval", "better in"]
    if published:
        head.append("published")
    rows = [[*head, *(results.columns[name].title for name in others), "seeds", "steps"]]
    for variant in results.variants(evaluation):
        scores = {name: results.score(variant, name, evaluation) for name in results.columns}
        means = {name: score.mean if score else None for name, score in scores.items()}
        shown = {name: results.shown(mean, name, sign=False) for name, mean in means.items()}
        score = scores[metric]
        apart = results.difference(variant, metric, evaluation)
        difference = results.shown(apart.mean if apart else None)
        row = [
            variant,
            shown.pop(metric),
            results.shown(score.deviation if score else None, sign=False),
            "reference" if variant == results.settings.reference else difference,
            results.interval(apart),
            apart.ahead(results.sign) if apart else "–",
        ]
        if published:
            row.append(results.shown(published.get(variant), sign=False))
        runs = results.stored[variant, evaluation].values()
        rows.append([*row, *shown.values(), str(len(runs)), steps_shown(runs)])
    # Baselines stand below the variants: they were not trained.
    for name, values in results.baselines(evaluation).items():
        first, *rest = [results.shown(values.get(m), m, sign=False) for m in (metric, *others)]
        dashes = ["–"] * (len(head) - 2)
        rows.append([name.replace("_", " "), first, *dashes, *rest, "–", "–"])
    return rows


def steps_shown(runs: Iterable[StoredResults]) -> str:
    """Steps of runs: 2,100, or from the fewest to the most where they differ."""
    # Budgets in seconds end at different steps.
    steps = sorted({stored.step for stored in runs if stored.step is not None})
    return " to ".join(f"{step:,}" for step in (*steps[:1], *steps[1:][-1:])) or "–"


def hypothesis_rows(results: Results) -> Rows:
    """The verdicts, headers first."""
    head = ["hypothesis", "metric", "left - right", "95 % interval", "verdict", "of", "note"]
    rows = [head]
    for judgement in results.judgements():
        estimate = judgement.estimate
        metric = judgement.metric
        reason = f" ({judgement.reason})" if judgement.reason else ""
        row = [
            judgement.hypothesis.claim,
            results.columns[metric].heading if metric in results.columns else metric,
            results.shown(estimate.mean if estimate else None, metric),
            results.interval(estimate, metric),
            judgement.verdict + reason,
            estimate.sample if estimate else "–",
            judgement.hypothesis.note,
        ]
        rows.append(row)
    # An empty column would only widen the table.
    with_notes = any(row[-1] for row in rows[1:])
    return rows if with_notes else [row[:-1] for row in rows]


def tables(results: Results) -> Iterator[tuple[str, Rows]]:
    """Rows of the verdicts and of the table of every evaluation that has results, with its name."""
    if results.settings.hypotheses:
        yield "", hypothesis_rows(results)
    for name in results.plan.evaluations:
        if results.variants(name):
            yield name, table_rows(results, name)


def show(results: Results, console: Console) -> None:
    """Print the answer, the tables, the notes."""
    print_lines(console, [answer(results)])
    for name, rows in tables(results):
        print_table(console, name, rows, **COMPACT)
    print_lines(console, notes(results))


def write_files(results: Results) -> None:
    """Write results.json and table.md; equal runs give equal files but for `times`."""
    parts = [answer(results)]
    for name, rows in tables(results):
        parts += [f"**{name}**"] if name else []
        parts.append(markdown_table(rows))
    text = "\n\n".join([*parts, bullets(notes(results))]) + "\n"
    write_text(results.plan.folder / "table.md", text)
    write_text(results.plan.folder / "results.json", as_json(record(results)))


def record(results: Results) -> dict[str, Any]:
    """Everything that the tables say, as plain values, and the times of every run."""
    settings = results.settings
    return {
        "title": results.plan.study.title,
        "answer": answer(results),
        "answered_by": results.shared,
        "reference": settings.reference,
        "seeds": list(settings.seeds),
        "budget": settings.budget.model_dump(exclude_none=True),
        "metric": results.metric,
        "table": [*_table_records(results)],
        "hypotheses": [
            {
                **judgement.hypothesis.model_dump(),
                "metric": judgement.metric,
                "verdict": judgement.verdict,
                "reason": judgement.reason,
                **_estimate_record(judgement.estimate),
            }
            for judgement in results.judgements()
        ],
        "rank_correlation": results.rank_correlation()[0],
        "notes": notes(results),
        "times": [*_time_records(results)],
    }


def _estimate_record(estimate: Estimate | None) -> dict[str, Any]:
    """Nothing where there is no estimate."""
    if estimate is None:
        return {}
    return {"mean": estimate.mean, "sd": estimate.deviation, **asdict(estimate)}


def _table_records(results: Results) -> Iterator[dict[str, Any]]:
    """Mean and difference to the reference of every variant, by evaluation and metric."""
    for evaluation in results.plan.evaluations:
        for variant in results.variants(evaluation):
            for metric in results.columns:
                if score := results.score(variant, metric, evaluation):
                    apart = results.difference(variant, metric, evaluation)
                    yield {
                        "evaluation": evaluation,
                        "variant": variant,
                        "metric": metric,
                        **_estimate_record(score),
                        "difference": _estimate_record(apart),
                        "steps": steps_shown(results.stored[variant, evaluation].values()),
                    }


def _time_records(results: Results) -> Iterator[dict[str, Any]]:
    """Measured times of every run, which no other machine or day repeats."""
    for run in results.plan.runs:
        # Of the clock of training, which pauses between sessions do not move.
        step, seconds = last_record(run.folder / "history.jsonl")
        milliseconds = 1000 * seconds / step if step else None
        known = {"variant": run.variant, "seed": run.seed, "step": step}
        yield {**known, "seconds": round(seconds, 1), "ms_per_step": milliseconds}
