"""The files of a study's results: JSON, CSV, Markdown, LaTeX."""

import csv
import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console

from qgs.engine.results import as_json, bullets, markdown_table, print_lines, print_table
from qgs.io.files import write_text
from qgs_studies.hypotheses import MAIN
from qgs_studies.queue import last_record
from qgs_studies.results import Estimate, Judgement, Results, Row

_MARKS = {"\\": r"\textbackslash{}", "_": r"\_", "%": r"\%", "&": r"\&", "#": r"\#", "$": r"\$"}


def table_rows(results: Results, evaluation: str = MAIN) -> list[list[str]]:
    """One table, headers first: the study's metric in full, means of the others."""
    metric, published = results.metric, results.plan.study.settings.published
    others = [name for name in results.columns if name != metric]
    titles = [results.columns[name].title for name in others]
    head = ["variant", results.column.title, "sd", "difference", "95 % interval", "better in"]
    rows = [[*head, *["published"] * bool(published), *titles, "seeds", "steps"]]
    for row in results.rows(evaluation):
        score, apart = row.scores.get(metric), row.differences.get(metric)
        means = [row.scores.get(name) for name in others]
        paper = [results.shown(published.get(row.variant), sign=False)]
        rows.append(
            [
                row.variant,
                results.shown(score.mean if score else None, sign=False),
                results.shown(score.deviation if score else None, sign=False),
                "reference"
                if row.variant == results.plan.study.settings.reference
                else results.shown(apart.mean if apart else None),
                results.interval(apart),
                _ahead(results, apart),
                *paper * bool(published),
                *(
                    results.shown(e.mean if e else None, name, sign=False)
                    for name, e in zip(others, means, strict=True)
                ),
                str(len(row.seeds)),
                steps_shown(row.steps),
            ]
        )
    for name, values in results.baselines(evaluation).items() if len(rows) > 1 else ():
        shown = {m: results.shown(values.get(m), m, sign=False) for m in (metric, *others)}
        dashes = ["–"] * (4 + bool(published))
        shown_others = [shown[name] for name in others]
        rows.append([name.replace("_", " "), shown[metric], *dashes, *shown_others, "–", "–"])
    return rows


def hypothesis_rows(results: Results) -> list[list[str]]:
    """The verdicts, headers first."""
    notes = any(hypothesis.note for hypothesis in results.plan.study.settings.hypotheses)
    head = ["hypothesis", "metric", "left - right", "95 % interval", "verdict", "of"]
    rows = [[*head, *["note"] * notes]]
    for j in results.judgements():
        mean = results.shown(j.estimate.mean, j.metric) if j.estimate else "–"
        column = results.columns.get(j.metric)
        interval = results.interval(j.estimate, j.metric) if j.estimate else "–"
        covers = j.estimate.covers if j.estimate else "–"
        verdict = f"{j.verdict} ({j.reason})" if j.reason else j.verdict
        claim = [j.hypothesis.claim, column.heading if column else j.metric]
        rows.append([*claim, mean, interval, verdict, covers, *[j.hypothesis.note] * notes])
    return rows


def steps_shown(steps: Sequence[int]) -> str:
    """2,100, or from the fewest to the most where runs differ."""
    return " to ".join(f"{step:,}" for step in (*steps[:1], *steps[1:][-1:])) or "–"


def show(results: Results, console: Console) -> None:
    """Print the answer, the table of the study's metric, the verdicts."""
    console.print(results.answer(), highlight=False, soft_wrap=True, markup=False)
    compact: dict[str, Any] = {"box": box.SIMPLE_HEAD, "collapse_padding": True, "pad_edge": False}
    for name in results.plan.evaluations:
        rows = [row[:6] for row in table_rows(results, name)]
        if len(rows) > 1:
            print_table(console, name, rows, **compact)
    if len(rows := hypothesis_rows(results)) > 1:
        print_table(console, "", [[*row[:1], *row[2:5]] for row in rows], **compact)
    print_lines(console, results.notes())


def write_files(results: Results) -> None:
    """results.json, table.csv, runs.csv, times.csv, table.md and table.tex in the study's folder.

    The numbers of all but times.csv follow from the runs alone, to the last digit.
    """
    folder = results.plan.folder
    write_text(folder / "results.json", as_json(record(results)))
    write_text(folder / "table.csv", _csv(_table_records(results)))
    write_text(folder / "runs.csv", _csv(_run_records(results)))
    write_text(folder / "times.csv", _csv(_time_records(results)))
    write_text(folder / "table.md", markdown(results))
    write_text(folder / "table.tex", latex(results))


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
        "hypotheses": [_judgement(j) for j in results.judgements()],
        "rank_correlation": results.rank_correlation(),
        "notes": results.notes(),
    }


def markdown(results: Results) -> str:
    """The answer, the verdicts, a table for each evaluation, the notes."""
    parts = [results.answer()]
    if len(rows := hypothesis_rows(results)) > 1:
        parts.append(markdown_table(rows))
    for name in results.plan.evaluations:
        rows = table_rows(results, name)
        if len(rows) > 1:
            parts += [f"**{name}**"] * bool(name) + [markdown_table(rows)]
    return "\n\n".join([*parts, bullets(results.notes())]) + "\n"


def latex(results: Results) -> str:
    """A booktabs table of the study's metric for each evaluation, ready for a paper."""
    parts = [f"% {results.answer()}", "% needs \\usepackage{booktabs}"]
    for name in results.plan.evaluations:
        head, *rows = [[*row[:5]] for row in table_rows(results, name)]
        if not rows:
            continue
        lines = [r"\begin{tabular}{lrrrr}", r"\toprule"]
        lines += [_latex_row(head), r"\midrule", *map(_latex_row, rows)]
        parts += [*[f"% {name}"] * bool(name), *lines, r"\bottomrule", r"\end{tabular}"]
    return "\n".join(parts) + "\n"


def _latex_row(cells: Iterable[str]) -> str:
    def cell(text: str) -> str:
        text = "".join(_MARKS.get(character, character) for character in text)
        for mark, written in (("↑", r"$\uparrow$"), ("↓", r"$\downarrow$"), ("–", "--")):
            text = text.replace(mark, written)
        return f"${text}$" if text[:1] in "+-[" and text != "--" else text

    return " & ".join(map(cell, cells)) + r" \\"


def _ahead(results: Results, apart: Estimate | None) -> str:
    if apart is None:
        return "–"
    sign = 1 if results.column.better == "higher" else -1
    ahead = sum(sign * value > 0 for value in apart.by_seed.values())
    return f"{ahead} of {len(apart.by_seed)}"


def _estimate(estimate: Estimate | None) -> dict[str, Any]:
    if estimate is None:
        return dict.fromkeys(("mean", "sd", "low", "high", "seeds", "scenes"))
    found = {"mean": estimate.mean, "sd": estimate.deviation}
    found |= {"low": estimate.low, "high": estimate.high}
    return {**found, "seeds": len(estimate.by_seed), "scenes": estimate.scenes}


def _judgement(j: Judgement) -> dict[str, Any]:
    told = {"claim": j.hypothesis.claim, "metric": j.metric, "verdict": j.verdict}
    return {**told, "reason": j.reason, **_estimate(j.estimate), "note": j.hypothesis.note}


def _table_records(results: Results) -> list[dict[str, Any]]:
    return [
        {
            "evaluation": name,
            "variant": row.variant,
            "metric": metric,
            **_record(row, metric),
            "steps": steps_shown(row.steps),
        }
        for name in results.plan.evaluations
        for row in results.rows(name)
        for metric in row.scores
    ]


def _record(row: Row, metric: str) -> dict[str, Any]:
    score, apart = row.scores[metric], _estimate(row.differences.get(metric))
    own = {"mean": score.mean, "sd": score.deviation, "seeds": len(score.by_seed)}
    between = {"difference": apart["mean"], "low": apart["low"], "high": apart["high"]}
    return {**own, "scenes": score.scenes, **between, "paired_seeds": apart["seeds"]}


def _run_records(results: Results) -> list[dict[str, Any]]:
    """Of every run the mean over scenes."""
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
    """Of every run what the clock said, which no other machine or day repeats."""
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


def write_all(results: Results) -> Path:
    """All files, the figures and the page; the page."""
    from qgs_studies.figures import write_figures
    from qgs_studies.page import study_html

    write_files(results)
    write_figures(results)
    page = results.plan.folder / "study.html"
    write_text(page, study_html(results))
    return page
