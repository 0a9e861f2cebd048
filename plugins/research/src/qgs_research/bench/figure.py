"""The figure of a sweep: time and memory against each axis, on logarithmic axes."""

from collections.abc import Mapping
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from qgs.drawing.figures import categorical, figure_style, hex_color
from qgs.wording import short_names
from qgs_research.bench.sweep import AXES, series_of

_STYLES = {"forward": "-", "step": "--"}
_COSTS = {"seconds": "seconds", "bytes": "memory beyond the idle process, MiB"}


def sweep_figure(report: Mapping[str, Any]) -> Figure:
    """A row for each axis: seconds with quartiles, and bytes; fitted exponents in the legend."""
    series = series_of(report["points"])
    axes = [*dict.fromkeys(axis for _, axis, _ in series)] or ["views"]
    recipes = [*dict.fromkeys(recipe for recipe, _, _ in series)]
    names = dict(zip(recipes, short_names(recipes), strict=True)) if recipes else {}
    with figure_style():
        figure = Figure(figsize=(8.4, 2.7 * len(axes)), layout="constrained")
        grid = figure.subplots(len(axes), 2, squeeze=False)
        for row, axis in zip(grid, axes, strict=True):
            for plot, (cost, title) in zip(row, _COSTS.items(), strict=True):
                plot.set(xscale="log", yscale="log", xlabel=AXES[axis], title=title)
                for fits, points in zip(report["fits"], series.values(), strict=True):
                    if fits["axis"] == axis:
                        color = hex_color(categorical(recipes.index(fits["recipe"])))
                        _draw_line(plot, fits, points, cost, color, names[fits["recipe"]])
                _label(plot)
    return figure


def _draw_line(
    plot: Axes, fits: Mapping[str, Any], points: Any, cost: str, color: str, name: str
) -> None:
    values = [point["value"] for point in points]
    if cost == "seconds":
        found = [point["seconds"] for point in points]
        costs = [seconds["median"] for seconds in found]
        ends = [s["lower_quartile"] for s in found], [s["upper_quartile"] for s in found]
        plot.vlines(values, *ends, color=color, linewidth=2, alpha=0.35)
    else:
        memory = [point["memory"] for point in points]
        costs = [(m["peak_bytes"] - m["idle_bytes"]) / 2**20 for m in memory]
    exponent = f": {fits[cost]['exponent']:.2f}" if fits[cost] else ""
    label = f"{name}, {fits['operation']}{exponent}"
    style = "o" + _STYLES[fits["operation"]]
    plot.plot(values, costs, style, color=color, markersize=3.5, label=label)
    plot.set_xticks(values)


def _label(plot: Axes) -> None:
    plot.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    for axis in (plot.xaxis, plot.yaxis):
        axis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axis.set_minor_formatter(NullFormatter())
    if plot.lines:
        plot.legend(fontsize=7)
