"""Figures of a study: points of every seed with intervals, learning curves."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from qgs.drawing.figures import INK, MUTED, categorical, figure_style, hex_color, running_mean
from qgs.files import read_records, replacing
from qgs.metrics.images import Psnr
from qgs_research.studies.hypotheses import MAIN
from qgs_research.studies.results import Estimate, Results

_POINTS = 200  # of a learning curve
_STYLES = ("-", "--", ":")
_COLORS = 6
"""Colours that are told apart: `categorical` repeats them."""


def write_figures(results: Results) -> None:
    """Write OUT/figures: values of every evaluation and curves, as PDF and PNG."""
    figures = {"curves": curves_figure(results)}
    for name in results.plan.evaluations:
        figures[f"values-{name}" if name else "values"] = values_figure(results, name)
    for name, figure in figures.items():
        if figure is None:
            continue
        for suffix in ("pdf", "png"):
            # Equal results give equal files: a PDF would hold the time.
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
    seeds = results.settings.seeds
    with figure_style():
        figure = Figure(figsize=(8.4, 1.2 + 0.32 * len(scores)), layout="constrained")
        left, right = figure.subplots(1, 2, sharey=True)
        for place, (variant, score) in enumerate(scores.items()):
            _draw(left, place, score, seeds)
            if apart := results.difference(variant, results.metric, evaluation):
                _draw(right, place, apart, seeds)
                if apart.low is not None and apart.high is not None:
                    right.hlines(place, apart.low, apart.high, color=hex_color(INK), linewidth=1.2)
        right.axvline(0, color=hex_color(MUTED), linewidth=0.9)
        left.set(yticks=range(len(scores)), yticklabels=[*scores])
        # The first variant of the study is the topmost, as in the table.
        left.invert_yaxis()
        for axes in (left, right):
            axes.locator_params(axis="x", nbins=5)
        if 1 < len(seeds) <= _COLORS:
            points, names = left.get_legend_handles_labels()
            shown = dict(zip(names, points, strict=True))
            figure.legend([*shown.values()], [*shown], loc="outside lower center", ncols=len(shown))
        column = results.column
        unit = f", {column.unit}" if column.unit else ""
        left.set(title=f"{column.heading}{unit}: one point a seed, mean")
        right.set(title=f"minus {results.settings.reference}, 95 % interval")
        figure.suptitle(evaluation, x=0.01, ha="left", fontsize=9)
    return figure


def _draw(axes: Axes, place: int, estimate: Estimate, seeds: Sequence[int]) -> None:
    """The mean, and a point for each seed, of its colour in all rows, slightly shifted."""
    axes.plot(estimate.mean, place, "|", color=hex_color(INK), markersize=14)
    for seed, value in estimate.by_seed.items():
        number = seeds.index(seed)
        shift = 0.22 * (number / max(len(seeds) - 1, 1) - 0.5)
        # All have one colour where there are too many to tell apart.
        color = hex_color(categorical(number if len(seeds) <= _COLORS else 0))
        axes.plot(value, place + shift, "o", color=color, markersize=3.5, label=f"seed {seed}")


def curves_figure(results: Results) -> Figure | None:
    """PSNR of the training views by step: mean over seeds, and from the lowest to the highest.

    Of runs that are done; of a variant that has none, of those that go on.
    """
    curves = {name: _curves(results, name) for name in results.plan.recipes}
    curves = {name: found for name, found in curves.items() if found}
    if not curves:
        return None
    with figure_style():
        figure = Figure(figsize=(8.4, 3.6), layout="constrained")
        axes = figure.subplots()
        for number, (name, found) in enumerate(curves.items()):
            # Runs of one budget in seconds end at different steps.
            last = min(steps[-1] for steps, _ in found)
            at = np.linspace(1, last, _POINTS)
            every = np.array([np.interp(at, steps, values) for steps, values in found])
            color = hex_color(categorical(number))
            style = _STYLES[number // _COLORS % len(_STYLES)]
            axes.plot(at, every.mean(0), style, color=color, label=name)
            axes.fill_between(at, every.min(0), every.max(0), color=color, alpha=0.12, linewidth=0)
        without = "; without trainings that failed" if results.failed else ""
        title = f"{Psnr.column.heading} of the training views, {Psnr.column.unit}{without}"
        axes.set(title=title, xlabel="steps")
        figure.legend(loc="outside right center")
    return figure


def _curves(results: Results, variant: str) -> list[tuple[np.ndarray, np.ndarray]]:
    """Steps and running means of runs of `variant`, see `curves_figure`."""
    runs = [run for run in results.plan.runs if run.variant == variant and not run.failed]
    done = [run for run in runs if results.plan.done(run)]
    found = []
    for run in done or runs:
        records = [r for r in read_records(run.folder / "history.jsonl") if "psnr" in r]
        # A running mean needs two values.
        if len(records) > 1:
            steps = np.array([record["step"] for record in records])
            found.append((steps, running_mean([record["psnr"] for record in records])))
    return found
