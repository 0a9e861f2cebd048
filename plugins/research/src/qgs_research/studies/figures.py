"""Figures of a study: points of every seed with intervals, learning curves."""

from matplotlib.figure import Figure

from qgs.drawing.figures import INK, categorical, figure_style, hex_color, running_mean
from qgs.files import read_records
from qgs_research.studies.results import Results


def values_figure(results: Results, evaluation: str) -> Figure | None:
    """Return the study's metric of every seed, and the differences to the reference."""
    names = results.models(evaluation)
    if not names:
        return None
    column = results.column
    unit = f", {column.unit}" if column.unit else ""
    with figure_style():
        figure = Figure(figsize=(8.4, 1.2 + 0.32 * len(names)), layout="constrained")
        left, right = figure.subplots(1, 2, sharey=True)
        for place, name in enumerate(names):
            score = results.score(name, results.metric, evaluation)
            apart = results.difference(name, results.metric, evaluation)
            for axes, estimate in ((left, score), (right, apart)):
                if estimate:
                    values = [*estimate.by_seed.values()]
                    axes.plot(values, [place] * len(values), "o", color=hex_color(categorical(1)))
                    axes.plot(estimate.mean, place, "|", color=hex_color(INK), markersize=14)
            # The mean of a variant has no interval here: other scenes would move all variants.
            if apart and apart.low is not None and apart.high is not None:
                right.hlines(place, apart.low, apart.high, color=hex_color(INK), linewidth=1.2)
        right.axvline(0, color=hex_color(INK), linewidth=0.9)
        left.set(yticks=range(len(names)), yticklabels=names)
        # The first variant of the study is the topmost, as in the table.
        left.invert_yaxis()
        left.set(title=f"{column.heading}{unit}: one point a seed, mean")
        right.set(title=f"minus {results.reference}, 95 % interval")
        figure.suptitle(evaluation, x=0.01, ha="left", fontsize=9)
    return figure


def curves_figure(results: Results) -> Figure | None:
    """Return PSNR of the training views by step, a line for each run."""
    variants = [*results.plan.recipes]
    with figure_style():
        figure = Figure(figsize=(8.4, 3.6), layout="constrained")
        axes = figure.subplots()
        for run in results.plan.runs:
            records = [r for r in read_records(run.folder / "history.jsonl") if "psnr" in r]
            # A running mean needs two values.
            if len(records) > 1:
                steps = [record["step"] for record in records]
                values = running_mean([record["psnr"] for record in records])
                color = hex_color(categorical(variants.index(run.variant)))
                axes.plot(steps, values, color=color, linewidth=0.9, label=run)
        axes.set(title="PSNR of the training views, dB", xlabel="steps")
        if not axes.lines:
            return None
        figure.legend(loc="outside right center")
    return figure
