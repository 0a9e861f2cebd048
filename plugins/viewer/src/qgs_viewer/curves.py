"""Curves of a training: loss and PSNR, by seconds or by steps."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib.figure import Figure

from qgs.drawing.figures import MUTED, categorical, figure_style, hex_color, running_mean
from qgs.files import read_records
from qgs.metrics.images import Psnr


@dataclass(frozen=True)
class Curves:
    """Records of a training: seconds since its start, loss, PSNR of supervised views, steps."""

    seconds: Sequence[float]
    loss: Sequence[float]
    psnr: Sequence[float]
    steps: Sequence[float]


def curves_figure(curves: Mapping[str, Curves]) -> Figure:
    """Draw loss and PSNR by seconds, by steps where one took over two hours; means are strong."""
    # the clock of a training of hours may hold pauses and other work
    long = max(max(run.seconds) for run in curves.values()) > 7200
    with figure_style():
        figure = Figure(figsize=(7, 2.6), layout="constrained")
        loss_axis, psnr_axis = figure.subplots(1, 2)
        for index, (name, run) in enumerate(curves.items()):
            color = hex_color(categorical(index))
            place = run.steps if long else run.seconds
            for axis, values in ((loss_axis, run.loss), (psnr_axis, run.psnr)):
                # single steps scatter; the pale line shows how much
                axis.plot(place, values, color=color, alpha=0.18, linewidth=0.7)
                axis.plot(place, running_mean(values), color=color, label=name)
        loss_axis.set(title="Training loss", xlabel="steps" if long else "seconds", yscale="log")
        title = f"{Psnr.column.heading} of the training views, {Psnr.column.unit}"
        psnr_axis.set(title=title, xlabel=loss_axis.get_xlabel())
        psnr_axis.legend(loc="lower right")
        loss_axis.yaxis.set_major_formatter("{x:g}")
        # a loss may stay within one power of ten, where major ticks alone say nothing
        loss_axis.yaxis.set_minor_formatter("{x:g}")
        loss_axis.tick_params(which="minor", color=hex_color(MUTED), labelsize=7)
    return figure


def curves_of(file: Path) -> Curves | None:
    """Read NAME.history.jsonl beside NAME.safetensors, or history.jsonl of its run.

    None without records; skipped steps are left out.
    """
    own = file.with_suffix(".history.jsonl")
    records = read_records(own if own.is_file() else file.with_name("history.jsonl"))
    names = {"seconds", "loss", "psnr", "step"}
    steps = [r for r in records if not r.get("skipped") and r.keys() >= names]
    if not steps:
        return None
    return Curves(
        seconds=[step["seconds"] for step in steps],
        loss=[step["loss"] for step in steps],
        psnr=[step["psnr"] for step in steps],
        steps=[step["step"] for step in steps],
    )
