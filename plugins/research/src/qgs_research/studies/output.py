"""The files of a study's results: JSON, CSV, Markdown, LaTeX."""

import csv
import io
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from rich.console import Console

from qgs.evaluate.results import as_json, bullets, markdown_table, print_lines, print_table
from qgs.files import write_text
from qgs_research.studies.hypotheses import MAIN
from qgs_research.studies.queue import last_record
from qgs_research.studies.results import Estimate, Results, Row
from qgs_research.studies.stored import COMPACT

_MARKS = {"\\": r"\textbackslash{}", "_": r"\_", "%": r"\%", "&": r"\&", "#": r"\#", "$": r"\$"}


def table_rows(results: Results, evaluation: str = MAIN) -> list[list[str]]:
    """One table, headers first: the study's metric in full, means of the others."""
    metric, settings = results.metric, results.plan.study.settings
    others, ranked = [name for name in results.columns if name != metric], bool(settings.published)

    def mean(row: Row, name: str) -> str:
        score = row.scores.get(name)
        return results.shown(score.mean if score else None, name, sign=False)

    head = ["variant", results.column.title, "sd", "difference", "95 % interval", "better in"]
    titles = [results.columns[name].title for name in others]
    rows = [[*head, *["published"] * ranked, *titles, "seeds", "steps"]]
    for row in results.rows(evaluation):
        score, apart = row.scores.get(metric), row.differences.get(metric)
        deviation = results.shown(score.deviation if score else None, sign=False)
        difference = results.shown(apart.mean if apart else None)
        if row.variant == settings.reference:
            difference = "reference"
        ahead = apart.ahead(results.sign) if apart else "–"
        cells = [mean(row, metric), deviation, difference, results.interval(apart), ahead]
        paper = [results.shown(settings.published.get(row.variant), sign=False)] * ranked
        means = [mean(row, name) for name in others]
        end = [str(len(row.seeds)), steps_shown(row.steps)]
        rows.append([row.variant, *cells, *paper, *means, *end])
    for name, values in results.baselines(evaluation).items() if len(rows) > 1 else ():
        first, *rest = [results.shown(values.get(m), m, sign=False) for m in (metric, *others)]
        dashes = ["–"] * (4 + ranked)
        rows.append([name.replace("_", " "), first, *dashes, *rest, "–", "–"])
    return rows


def hypothesis_rows(results: Results) -> list[list[str]]:
    """The verdicts, headers first."""
    notes = any(hypothesis.note for hypothesis in results.plan.study.settings.hypotheses)
    head = ["hypothesis", "metric", "left - right", "95 % interval", "verdict", "of"]
    rows = [[*head, *["note"] * notes]]
    for j in results.judgements():
        column, cells = results.columns.get(j.metric), ["–", "–"]
        if j.estimate:
            cells = [
                results.shown(j.estimate.mean, j.metric),
                results.interval(j.estimate, j.metric),
            ]
        verdict = f"{j.verdict} ({j.reason})" if j.reason else j.verdict
        covers, note = j.estimate.covers if j.estimate else "–", [j.hypothesis.note] * notes
        claim = [j.hypothesis.claim, column.heading if column else j.metric]
        rows.append([*claim, *cells, verdict, covers, *note])
    return rows


def steps_shown(steps: Sequence[int]) -> str:
    """2,100, or from the fewest to the most where runs differ."""
    return " to ".join(f"{step:,}" for step in (*steps[:1], *steps[1:][-1:])) or "–"


def show(results: Results, console: Console) -> None:
    """Print the answer, the table of the study's metric, the verdicts."""
    console.print(results.answer(), highlight=False, soft_wrap=True, markup=False)
    for name, rows in _tables(results):
        print_table(console, name, [row[:6] for row in rows], **COMPACT)
    if len(rows := hypothesis_rows(results)) > 1:
        print_table(console, "", [[*row[:1], *row[2:5]] for row in rows], **COMPACT)
    print_lines(console, results.notes())


def write_files(results: Results) -> None:
    """results.json, table.csv, runs.csv, times.csv, table.md and table.tex in the study's folder.

    The numbers of all but times.csv follow from the runs alone, to the last digit.
    """
    texts = {
        "results.json": as_json(record(results)),
        "table.csv": _csv(_table_records(results)),
        "runs.csv": _csv(_run_records(results)),
        "times.csv": _csv(_time_records(results)),
        "table.md": markdown(results),
        "table.tex": latex(results),
    }
    for name, text in texts.items():
        write_text(results.plan.folder / name, text)


def record(results: Results) -> dict[str, Any]:
    """Everything that the tables say, as plain values."""
    settings = results.plan.study.settings
    return {
        "title": results.plan.study.title,
        "answer": results.answer(),
        "answered_by": results.shared,
        "reference": settings.reference,
        "seeds": list(settings.seeds),
        "budget": settings.budget.model_dump(exclude_none=True),
        "metric": results.metric,
        "table": _table_records(results),
        "hypotheses": [
            {
                "claim": j.hypothesis.claim,
                "metric": j.metric,
                "verdict": j.verdict,
                "reason": j.reason,
                **_estimate(j.estimate),
                "note": j.hypothesis.note,
            }
            for j in results.judgements()
        ],
        "rank_correlation": results.rank_correlation()[0],
        "notes": results.notes(),
    }


def markdown(results: Results) -> str:
    """The answer, the verdicts, a table for each evaluation, the notes."""
    parts = [results.answer()]
    if len(rows := hypothesis_rows(results)) > 1:
        parts.append(markdown_table(rows))
    for name, rows in _tables(results):
        parts += [f"**{name}**"] * bool(name) + [markdown_table(rows)]
    return "\n\n".join([*parts, bullets(results.notes())]) + "\n"


def latex(results: Results) -> str:
    """A booktabs table of the study's metric for each evaluation, ready for a paper."""
    parts = [f"% {results.answer()}", "% needs \\usepackage{booktabs}"]
    for name, table in _tables(results):
        head, *rows = [row[:5] for row in table]
        lines = [r"\begin{tabular}{lrrrr}", r"\toprule"]
        lines += [_latex_row(head), r"\midrule", *map(_latex_row, rows)]
        parts += [*[f"% {name}"] * bool(name), *lines, r"\bottomrule", r"\end{tabular}"]
    return "\n".join(parts) + "\n"


def _tables(results: Results) -> Iterator[tuple[str, list[list[str]]]]:
    """Name and rows of the table of every evaluation that has results."""
    for name in results.plan.evaluations:
        if len(rows := table_rows(results, name)) > 1:
            yield name, rows


def _latex_row(cells: Iterable[str]) -> str:
    def cell(text: str) -> str:
        text = "".join(_MARKS.get(character, character) for character in text)
        for mark, written in (("↑", r"$\uparrow$"), ("↓", r"$\downarrow$"), ("–", "--")):
            text = text.replace(mark, written)
        return f"${text}$" if text[:1] in "+-[" and text != "--" else text

    return " & ".join(map(cell, cells)) + r" \\"


def _estimate(estimate: Estimate | None) -> dict[str, Any]:
    if estimate is None:
        return dict.fromkeys(("mean", "sd", "low", "high", "seeds", "scenes"))
    return {
        "mean": estimate.mean,
        "sd": estimate.deviation,
        "low": estimate.low,
        "high": estimate.high,
        "seeds": len(estimate.by_seed),
        "scenes": estimate.scenes,
    }


def _table_records(results: Results) -> list[dict[str, Any]]:
    found = []
    for name in results.plan.evaluations:
        for row in results.rows(name):
            for metric, score in row.scores.items():
                own, apart = _estimate(score), _estimate(row.differences.get(metric))
                found.append(
                    {
                        "evaluation": name,
                        "variant": row.variant,
                        "metric": metric,
                        **{key: own[key] for key in ("mean", "sd", "seeds", "scenes")},
                        "difference": apart["mean"],
                        "low": apart["low"],
                        "high": apart["high"],
                        "paired_seeds": apart["seeds"],
                        "steps": steps_shown(row.steps),
                    }
                )
    return found


def _run_records(results: Results) -> list[dict[str, Any]]:
    """The mean over scenes of every run."""
    return [
        {
            "evaluation": name,
            "variant": row.variant,
            "seed": seed,
            **{m: e.by_seed.get(seed) for m, e in row.scores.items()},
        }
        for name in results.plan.evaluations
        for row in results.rows(name)
        for seed in row.seeds
    ]


def _time_records(results: Results) -> list[dict[str, Any]]:
    """Measured times of every run, which no other machine or day repeats."""
    found = []
    for run in results.plan.runs:
        step, seconds = last_record(run.folder / "history.jsonl")
        each = 1000 * seconds / step if step else None
        known = {"variant": run.variant, "seed": run.seed, "step": step}
        found.append({**known, "seconds": round(seconds, 1), "ms_per_step": each})
    return found


def _csv(records: Sequence[dict[str, Any]]) -> str:
    text = io.StringIO()
    fields = list(dict.fromkeys(key for one in records for key in one))
    writer = csv.DictWriter(text, fields, lineterminator="\n")
    writer.writeheader()
    writer.writerows(records)
    return text.getvalue()
