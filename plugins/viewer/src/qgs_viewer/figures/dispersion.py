"""Figure: how far the Gaussians of a query scatter, scene by scene."""

import re
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from qgs.data.samples import Sample
from qgs.drawing.figures import categorical, hex_color
from qgs.metrics.dispersion import token_dispersion
from qgs.types import Gaussians
from qgs_viewer.figures import paper
from qgs_viewer.figures.exhibits import Exhibition, sample_name
from qgs_viewer.figures.paper import Made, logarithmic, new_figure, paper_style

LONGEST = 40  # scenes that are named each under its bars; of more every n-th
FEWEST = 8  # scenes that there is room for, so that the bars of few are not broad
IN_A_LINE = 3  # names of models in the legend
LETTERS = 110  # that fit below all bars side by side


def made(show: Exhibition) -> Made:
    """See `figure`."""
    found = {}
    for name, model in show.models.items():
        device = next(model.parameters()).device
        with torch.no_grad():
            scenes = [model(sample.inputs.to(device)).gaussians for sample in show.samples]
        found[name] = dispersions(scenes, model.head.gaussians_per_query)
    caption = paper.caption("dispersion", count=len(show.samples))
    return Made(figure(found, scene_labels(show.samples)), caption)


@torch.no_grad()
def dispersions(made: Iterable[Gaussians], per_query: int) -> dict[str, list[float]]:
    """The values of the metric `qgs/dispersion`, "mean" and "median", of what each scene became."""
    values: dict[str, list[float]] = {"mean": [], "median": []}
    for gaussians in made:
        distances = token_dispersion(gaussians.means, per_query)
        values["mean"].append(float(distances.mean()))
        values["median"].append(float(torch.quantile(distances, 0.5)))
    return values


def scene_labels(samples: Sequence[Sample]) -> list[str]:
    """Names of the samples without the words that all begin with, numbers without zeros."""
    names = [re.findall(r"[^\s/_-]*[\s/_-]*", sample_name(s, samples)) for s in samples]
    words = enumerate(zip(*names, strict=False))
    shared = next((place for place, found in words if len({*found}) > 1), 0)
    rest = ["".join(name[shared:]) for name in names]
    return [str(int(name)) for name in rest] if all(map(str.isdecimal, rest)) else rest


@paper_style()
def figure(values: Mapping[str, Mapping[str, Sequence[float]]], labels: Sequence[str]) -> Figure:
    """Bars by scene for each model by name and each of its values; its mean as a dashed line."""
    kinds = list(next(iter(values.values())))
    lines = -(-len(values) // IN_A_LINE) - 1  # of the legend, after its first
    drawn = new_figure((1.55 + 0.16 * lines) * len(kinds) + 0.3, gap=0.04)
    axes = drawn.subplots(len(kinds), 1, sharex=True, squeeze=False)[:, 0]
    for axis, kind in zip(axes, kinds, strict=True):
        _bars(axis, {name: found[kind] for name, found in values.items()})
        axis.set(ylabel=f"{kind}, world units")
    every = -(-len(labels) // LONGEST)
    beside = max(0.1, (FEWEST - len(labels)) / 2)
    turned = 90 if sum(map(len, labels[::every])) > LETTERS else 0
    axes[-1].set_xticks(np.arange(len(labels))[::every], labels[::every], rotation=turned)
    axes[-1].set(xlabel="test scene", xlim=(-0.5 - beside, len(labels) - 0.5 + beside))
    return drawn


def _bars(axis: Axes, values: Mapping[str, Sequence[float]]) -> None:
    wide = 0.8 / len(values)
    for number, (name, found) in enumerate(values.items()):
        color, mean = hex_color(categorical(number)), float(np.mean(found))
        places = np.arange(len(found)) + (number - (len(values) - 1) / 2) * wide
        axis.bar(places, found, 0.92 * wide, color=color, label=f"{name}, mean {mean:.3g}")
        axis.axhline(mean, color=color, linestyle=(0, (4, 2)), linewidth=0.9)
    every = [value for found in values.values() for value in found]
    if logarithmic(axis, every):
        axis.set_ylim(min(every) / 3, max(every) * 1.5)
    axis.tick_params(axis="x", length=0)
    axis.grid(visible=False, axis="x")
    axis.legend(
        loc="lower right", bbox_to_anchor=(1, 1), ncols=min(len(values), IN_A_LINE), borderaxespad=0
    )
