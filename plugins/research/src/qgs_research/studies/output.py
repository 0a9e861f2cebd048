"""The files of a study: results.json, table.md, study.html and the figures."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from qgs.drawing import page_environment
from qgs.drawing.figures import figure_picture, figure_style
from qgs.drawing.images import data_uri
from qgs.evaluate.results import as_json
from qgs.files import read_records, replacing, write_text
from qgs_research.studies.estimates import interval_shown, shown
from qgs_research.studies.figures import curves_figure, values_figure
from qgs_research.studies.results import Judgement, Results
from qgs_research.studies.runs import differences
from qgs_research.studies.statements import answer, notes
from qgs_research.studies.tables import Rows, Summary, table_records, table_rows

_DPI = 160


def write_all(results: Results) -> Path:
    """Write all files; return the page."""
    write_files(results)
    figures = write_figures(results)
    page = results.plan.folder / "study.html"
    write_text(page, study_html(results, figures))
    return page


def write_files(results: Results) -> None:
    """Write results.json and table.md; equal runs give equal files but for `times`."""
    write_text(results.plan.folder / "table.md", study_summary(results).markdown)
    write_text(results.plan.folder / "results.json", as_json(record(results)))


def write_figures(results: Results) -> dict[str, Figure]:
    """Write figures/: values of every evaluation and learning curves; return them by name."""
    figures = {"curves": curves_figure(results)}
    for name in results.plan.evaluations:
        figures[f"values-{name}" if name else "values"] = values_figure(results, name)
    written: dict[str, Figure] = {}
    for name, figure in figures.items():
        if figure is None:
            continue
        written[name] = figure
        for suffix in ("pdf", "png"):
            # Equal results give equal files: a PDF would hold the time.
            metadata = {"CreationDate": None} if suffix == "pdf" else None
            file = results.plan.folder / "figures" / f"{name}.{suffix}"
            with replacing(file) as path, figure_style():
                figure.savefig(path, format=suffix, dpi=_DPI, metadata=metadata)
    return written


def study_html(results: Results, figures: dict[str, Figure]) -> str:
    """Return the whole page; it needs no other file and no network."""
    recipes = results.plan.recipes
    reference = recipes[results.reference]
    template = page_environment("qgs_research.studies", uri=data_uri).get_template("study.html")
    return template.render(
        plan=results.plan,
        settings=results.settings,
        missing=len(results.missing),
        summary=study_summary(results),
        pictures={name: figure_picture(figure, _DPI) for name, figure in figures.items()},
        changes={name: differences(recipe, reference) for name, recipe in recipes.items()},
    )


def study_summary(results: Results) -> Summary:
    """Return the answer, the verdicts, the table of every evaluation that has results, notes."""
    tables = [("", _hypothesis_rows(results))] if results.settings.hypotheses else []
    others = [name for name in results.columns if name != results.metric]
    published = results.settings.published
    for name in results.plan.evaluations:
        if results.models(name):
            rows = table_rows(results, name, results.metric, others, published)
            tables.append((name, rows))
    return Summary(answer=answer(results), tables=tables, notes=notes(results))


def _hypothesis_rows(results: Results) -> Rows:
    head = ["hypothesis", "metric", "left - right", "95 % interval", "verdict", "of", "note"]
    rows = [head, *(_hypothesis_row(results, judgement) for judgement in results.judgements())]
    # An empty column would only widen the table.
    with_notes = any(row[-1] for row in rows[1:])
    return rows if with_notes else [row[:-1] for row in rows]


def _hypothesis_row(results: Results, judgement: Judgement) -> list[str]:
    column = results.columns.get(judgement.metric, results.column)
    estimate = judgement.estimate
    reason = f" ({judgement.reason})" if judgement.reason else ""
    return [
        judgement.hypothesis.claim,
        column.heading,
        shown(column, estimate.mean if estimate else None, "+"),
        interval_shown(column, estimate),
        judgement.verdict + reason,
        estimate.sample if estimate else "–",
        judgement.hypothesis.note,
    ]


def record(results: Results) -> dict[str, Any]:
    """Return everything that the tables say, as plain values, and the times of every run."""
    settings = results.settings
    table = [row for name in results.plan.evaluations for row in table_records(results, name)]
    return {
        "title": results.plan.study.title,
        "answer": answer(results),
        "answered_by": results.shared,
        "reference": settings.reference,
        "seeds": list(settings.seeds),
        "budget": settings.budget.model_dump(exclude_none=True),
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
        "rank_correlation": results.rank_correlation()[0],
        "notes": notes(results),
        "times": [*_times(results)],
    }


def _times(results: Results) -> Iterator[dict[str, Any]]:
    """Yield measured times of every run, which no other machine or day repeats."""
    for run in results.plan.runs:
        records = read_records(run.folder / "history.jsonl")
        # Of the clock of training, which pauses between sessions do not move.
        last = records[-1] if records else {"step": 0, "seconds": 0.0}
        yield {
            "variant": run.variant,
            "seed": run.seed,
            "step": last["step"],
            "seconds": round(last["seconds"], 1),
            "ms_per_step": 1000 * last["seconds"] / last["step"] if records else None,
        }
