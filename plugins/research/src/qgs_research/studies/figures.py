"""Figures of a study: points of every seed with intervals, learning curves."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from qgs.drawing.figures import (
    CATEGORICAL,
    INK,
    MUTED,
    categorical,
    figure_style,
    hex_color,
    running_mean,
)
from qgs.files import read_records, replacing
from qgs.metrics.images import Psnr
from qgs_research.studies.hypotheses import MAIN
from qgs_research.studies.results import Results

_POINTS = 200  # of a learning curve
_POINT: dict[str, Any] = {"marker": "o", "linestyle": "", "markersize": 3.5}


def write_figures(results: Results) -> None:
    """OUT/figures: values of every evaluation and curves, as PDF and PNG."""
    names = results.plan.evaluations
    figures = {f"values-{n}" if n else "values": values_figure(results, n) for n in names}
    for name, figure in {**figures, "curves": curves_figure(results)}.items():
        if figure is None:
            continue
        for suffix in ("pdf", "png"):
            with replacing(results.plan.folder / "figures" / f"{name}.{suffix}") as path:
                metadata = {"CreationDate": None} if suffix == "pdf" else None
                with figure_style():
                    figure.savefig(path, format=suffix, dpi=160, metadata=metadata)


def values_figure(results: Results, evaluation: str = MAIN) -> Figure | None:
    """The study's metric of every seed, and the differences to the reference with intervals."""
    rows = [row for row in results.rows(evaluation) if results.metric in row.scores]
    if not rows:
        return None
    column, metric = results.column, results.metric
    unit = f", {column.unit}" if column.unit else ""
    several = results.plan.study.settings.seeds
    apart = len(several) <= len(CATEGORICAL)  # else all seeds have one colour
    seeds = {seed: hex_color(categorical(n * apart)) for n, seed in enumerate(several)}
    with figure_style():
        figure = Figure(figsize=(8.4, 1.2 + 0.32 * len(rows)), layout="constrained")
        left, right = figure.subplots(1, 2, sharey=True)
        for place, row in enumerate(rows):
            _points(left, place, row.scores[metric].by_seed, seeds)
            left.plot(row.scores[metric].mean, place, "|", color=hex_color(INK), markersize=14)
            if apart := row.differences.get(metric):
                if apart.low is not None and apart.high is not None:
                    ends, at = [apart.low, apart.high], [place, place]
                    right.plot(ends, at, color=hex_color(INK), linewidth=1.2)
                _points(right, place, apart.by_seed, seeds)
                right.plot(apart.mean, place, "|", color=hex_color(INK), markersize=14)
        right.axvline(0, color=hex_color(MUTED), linewidth=0.9)
        left.set(yticks=range(len(rows)), yticklabels=[row.variant for row in rows])
        left.invert_yaxis()
        for axes in (left, right):
            axes.locator_params(axis="x", nbins=5)
        if len(set(seeds.values())) > 1:
            points = [Line2D([], [], color=color, **_POINT) for color in seeds.values()]
            names = [f"seed {seed}" for seed in seeds]
            figure.legend(points, names, loc="outside lower center", ncols=len(seeds))
        left.set(title=f"{column.heading}{unit}: one point a seed, mean")
        right.set(title=f"minus {results.plan.study.settings.reference}, 95 % interval")
        if evaluation:
            figure.suptitle(evaluation, x=0.01, ha="left", fontsize=9)
    return figure


def _points(axes: Axes, place: int, values: Mapping[int, float], seeds: Mapping[int, str]) -> None:
    """A point for each seed, of its colour in all rows, slightly shifted."""
    for number, (seed, color) in enumerate(seeds.items()):
        if seed in values:
            shift = 0.22 * (number - (len(seeds) - 1) / 2) / max(len(seeds) - 1, 1)
            axes.plot(values[seed], place + shift, color=color, **_POINT)


def curves_figure(results: Results) -> Figure | None:
    """PSNR of the training views by step: mean over seeds, and from the lowest to the highest.

    Of runs that are done; of a variant that has none, of those that go on.
    """
    curves = {name: _curves(results, name) for name in results.plan.recipes}
    known = {name: found for name, found in curves.items() if found}
    if not known:
        return None
    with figure_style():
        figure = Figure(figsize=(8.4, 3.6), layout="constrained")
        axes = figure.subplots()
        for number, (name, found) in enumerate(known.items()):
            last = min(steps[-1] for steps, _ in found)
            at = np.linspace(1, last, _POINTS)
            every = np.array([np.interp(at, steps, values) for steps, values in found])
            color, style = hex_color(categorical(number)), ("-", "--", ":")[number // 6 % 3]
            axes.plot(at, every.mean(0), style, color=color, label=name)
            axes.fill_between(at, every.min(0), every.max(0), color=color, alpha=0.12, linewidth=0)
        title = f"{Psnr.column.heading} of the training views, {Psnr.column.unit}"
        title += "; without trainings that failed" * bool(results.failed)
        axes.set(title=title, xlabel="steps")
        figure.legend(loc="outside right center")
    return figure


def _curves(results: Results, variant: str) -> list[tuple[np.ndarray, np.ndarray]]:
    """Steps and running means of runs of `variant`, see `curves_figure`."""
    runs = [run for run in results.plan.runs if run.variant == variant and not run.failed]
    done, found = [run for run in runs if results.plan.done(run)], []
    for run in done or runs:
        records = read_records(run.folder / "history.jsonl")
        pairs = [(r["step"], r["psnr"]) for r in records if "psnr" in r]
        if len(pairs) > 1:
            steps, values = np.array(pairs, float).T
            found.append((steps, running_mean(values)))
    return found
