"""Draw training loss and PSNR over the steps of trainings."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from qgs.drawing.figures import figure_style
from qgs.files import read_records
from qgs.metrics.images import Psnr
from qgs_viewer.look import MUTED, categorical, hex_color, running_mean

Curves = Sequence[Mapping[str, Any]]
"""Records of a training: step, seconds since the start, loss, PSNR of the supervised views."""


def curves_figure(curves: Mapping[str, Curves]) -> Figure:
    """Draw loss and PSNR over steps: values as pale lines, their running means as strong lines.

    curves: records of each training, by name of the model.
    """
    with figure_style():
        figure = Figure(figsize=(7, 2.6), layout="constrained")
        loss_axis, psnr_axis = figure.subplots(1, 2)
        for index, (name, run) in enumerate(curves.items()):
            color = hex_color(categorical(index))
            steps = [record["step"] for record in run]
            for axis, value in ((loss_axis, "loss"), (psnr_axis, "psnr")):
                values = [record[value] for record in run]
                # single steps scatter; the pale line shows how much
                axis.plot(steps, values, color=color, alpha=0.18, linewidth=0.7)
                axis.plot(steps, running_mean(values), color=color, label=name)
        loss_axis.set(title="Training loss", xlabel="steps", yscale="log")
        title = f"{Psnr.column.heading} of the training views, {Psnr.column.unit}"
        psnr_axis.set(title=title, xlabel="steps")
        # PSNR rises, which leaves this corner free
        psnr_axis.legend(loc="lower right")
        loss_axis.yaxis.set_major_formatter("{x:g}")
        # a loss may stay within one power of ten, where major ticks alone say nothing
        loss_axis.yaxis.set_minor_formatter("{x:g}")
        loss_axis.tick_params(which="minor", color=hex_color(MUTED), labelsize=7)
    return figure


def curves_of(file: Path) -> Curves:
    """Return the stored records of a training, except skipped steps; empty if there are none.

    file: checkpoint NAME.safetensors. The history is read from NAME.history.jsonl in the same
    folder, or else from history.jsonl.
    """
    own = file.with_suffix(".history.jsonl")
    records = read_records(own if own.is_file() else file.with_name("history.jsonl"))
    names = {"loss", "psnr", "step"}
    return [r for r in records if not r.get("skipped") and r.keys() >= names]
