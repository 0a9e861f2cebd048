"""The figure of a sweep: time and counted memory against each axis, on logarithmic axes."""

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from qgs.drawing.figures import categorical, figure_style, hex_color
from qgs.wording import short_names
from qgs_bench.sweep import AXES

_STYLES = {"forward": "-", "step": "--"}
_COSTS = {"seconds": "seconds", "counted_bytes": "tensors at the peak, MiB"}
_WORDS = {"forward": "forward", "step": "training step"}


def sweep_figure(report: Mapping[str, Any]) -> Figure:
    """A row for each axis: seconds with quartiles, and bytes; fitted exponents in the legend."""
    series = report["series"]
    axes = [*dict.fromkeys(s["axis"] for s in series)]
    recipes = [*dict.fromkeys(s["recipe"] for s in series)]
    names = dict(zip(recipes, short_names(recipes), strict=True))
    with figure_style():
        figure = Figure(figsize=(8.4, 2.7 * len(axes)), layout="constrained")
        grid = figure.subplots(len(axes), 2, squeeze=False)
        for row, axis in zip(grid, axes, strict=True):
            for plot, cost in zip(row, _COSTS, strict=True):
                of_axis = [s for s in series if s["axis"] == axis and s["points"]]
                for one in of_axis:
                    color = hex_color(categorical(recipes.index(one["recipe"])))
                    _line(plot, one, cost, color, names[one["recipe"]])
                _label(plot, axis, _COSTS[cost], [p["value"] for s in of_axis for p in s["points"]])
    return figure


def _line(plot: Axes, series: Mapping[str, Any], cost: str, color: str, name: str) -> None:
    values = [point["value"] for point in series["points"]]
    if cost == "seconds":
        found = [point["seconds"] for point in series["points"]]
        costs = [seconds["median"] for seconds in found]
        ends = [s["lower_quartile"] for s in found], [s["upper_quartile"] for s in found]
        plot.vlines(values, *ends, color=color, linewidth=2, alpha=0.35)
    else:
        costs = [point[cost] / 2**20 for point in series["points"]]
    fit, operation = series["fits"][cost], series["operation"]
    told = f": {fit['exponent']:.2f}" if fit else ""
    label = f"{name}, {_WORDS[operation]}{told}"
    plot.plot(values, costs, "o" + _STYLES[operation], color=color, markersize=3.5, label=label)


def _label(plot: Axes, axis: str, cost: str, values: Sequence[int]) -> None:
    plot.set(xscale="log", yscale="log", xlabel=AXES[axis], title=cost)
    plot.set_xticks(sorted({*values}))
    plot.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    for of_axis in (plot.xaxis, plot.yaxis):
        of_axis.set_major_formatter(StrMethodFormatter("{x:g}"))
        of_axis.set_minor_formatter(NullFormatter())
    if values:
        plot.legend(fontsize=7)
