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
from qgs_research.studies.results import Estimate, Results

_POINTS = 200  # of a learning curve
_POINT: dict[str, Any] = {"marker": "o", "linestyle": "", "markersize": 3.5}
_STYLES = ("-", "--", ":")
_COLORS = 6
"""Curves of different colours in one style of line."""


def write_figures(results: Results) -> None:
    """Write OUT/figures: values of every evaluation and curves, as PDF and PNG."""
    figures = {"curves": curves_figure(results)}
    for name in results.plan.evaluations:
        figures[f"values-{name}" if name else "values"] = values_figure(results, name)
    for name, figure in figures.items():
        if figure is None:
            continue
        for suffix in ("pdf", "png"):
            # Equal results give equal files: PDF would hold the time.
            metadata = {"CreationDate": None} if suffix == "pdf" else None
            file = results.plan.folder / "figures" / f"{name}.{suffix}"
            with replacing(file) as path, figure_style():
                figure.savefig(path, format=suffix, dpi=160, metadata=metadata)


def values_figure(results: Results, evaluation: str = MAIN) -> Figure | None:
    """The study's metric of every seed, and the differences to the reference with intervals."""
    scores: dict[str, Estimate] = {}
    for variant in results.variants(evaluation):
        if score := results.score(variant, results.metric, evaluation):
            scores[variant] = score
    if not scores:
        return None
    column = results.column
    seeds = _seed_colors(results)
    with figure_style():
        figure = Figure(figsize=(8.4, 1.2 + 0.32 * len(scores)), layout="constrained")
        left, right = figure.subplots(1, 2, sharey=True)
        for place, (variant, score) in enumerate(scores.items()):
            _draw(left, place, score, seeds)
            if apart := results.difference(variant, results.metric, evaluation):
                _draw(right, place, apart, seeds)
                if apart.low is not None and apart.high is not None:
                    right.plot(
                        [apart.low, apart.high], [place, place], color=hex_color(INK), lw=1.2
                    )
        right.axvline(0, color=hex_color(MUTED), linewidth=0.9)
        left.set(yticks=range(len(scores)), yticklabels=[*scores])
        left.invert_yaxis()
        for axes in (left, right):
            axes.locator_params(axis="x", nbins=5)
        if len(set(seeds.values())) > 1:
            points = [Line2D([], [], color=color, **_POINT) for color in seeds.values()]
            names = [f"seed {seed}" for seed in seeds]
            figure.legend(points, names, loc="outside lower center", ncols=len(seeds))
        unit = f", {column.unit}" if column.unit else ""
        left.set(title=f"{column.heading}{unit}: one point a seed, mean")
        right.set(title=f"minus {results.settings.reference}, 95 % interval")
        if evaluation:
            figure.suptitle(evaluation, x=0.01, ha="left", fontsize=9)
    return figure


def _seed_colors(results: Results) -> dict[int, str]:
    """A colour for each seed; one for all where there are more seeds than colours."""
    seeds = results.settings.seeds
    enough = len(seeds) <= len(CATEGORICAL)
    return {seed: hex_color(categorical(n if enough else 0)) for n, seed in enumerate(seeds)}


def _draw(axes: Axes, place: int, estimate: Estimate, seeds: Mapping[int, str]) -> None:
    """The mean, and a point for each seed, of its colour in all rows, slightly shifted."""
    axes.plot(estimate.mean, place, "|", color=hex_color(INK), markersize=14)
    for number, (seed, color) in enumerate(seeds.items()):
        if seed in estimate.by_seed:
            shift = 0.22 * (number - (len(seeds) - 1) / 2) / max(len(seeds) - 1, 1)
            axes.plot(estimate.by_seed[seed], place + shift, color=color, **_POINT)


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
            color = hex_color(categorical(number))
            style = _STYLES[number // _COLORS % len(_STYLES)]
            axes.plot(at, every.mean(0), style, color=color, label=name)
            axes.fill_between(at, every.min(0), every.max(0), color=color, alpha=0.12, linewidth=0)
        title = f"{Psnr.column.heading} of the training views, {Psnr.column.unit}"
        if results.failed:
            title += "; without trainings that failed"
        axes.set(title=title, xlabel="steps")
        figure.legend(loc="outside right center")
    return figure


def _curves(results: Results, variant: str) -> list[tuple[np.ndarray, np.ndarray]]:
    """Steps and running means of runs of `variant`, see `curves_figure`."""
    runs = [run for run in results.plan.runs if run.variant == variant and not run.failed]
    done = [run for run in runs if results.plan.done(run)]
    found = []
    for run in done or runs:
        records = read_records(run.folder / "history.jsonl")
        pairs = [(record["step"], record["psnr"]) for record in records if "psnr" in record]
        if len(pairs) > 1:
            steps, values = np.array(pairs, float).T
            found.append((steps, running_mean(values)))
    return found
