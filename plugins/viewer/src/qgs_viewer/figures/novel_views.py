"""Figure: views that a model never saw, beside the truth, with depth and error."""

from collections.abc import Mapping, Sequence
from math import ceil

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from qgs.data.samples import Sample
from qgs.drawing.images import DEPTH_MAP, depth_picture, depth_range, rgb_picture
from qgs.metrics.images import Psnr, psnr
from qgs.model import QueryGaussianModel
from qgs.types import Rendering
from qgs_viewer.figures import paper
from qgs_viewer.figures.exhibits import Exhibition, sample_name
from qgs_viewer.figures.paper import WIDTH, Made, blank_panel, new_figure, picture_panel, tag
from qgs_viewer.pictures import ERROR_MAP, color_error, error_picture

SCENES = 3
INPUTS = 2  # input views of each scene that are shown
TITLES = ("error", "depth", "true depth", "render", "truth", *["inputs"] * INPUTS)
"""Of columns, from the right; the true depth has one only where it is known."""
TRUE = " of the models' and the true depth, which is shown where it is known"


def made(show: Exhibition) -> Made:
    """See `figure`."""
    samples, first = show.samples[:SCENES], show.samples[0]
    target = first.label(first.target_frames[len(first.target_frames) // 2])
    more = len(first.input_frames) - INPUTS
    caption = paper.caption(
        "novel_views",
        scenes=", ".join(sample_name(s, samples) for s in samples),
        photos=len(first.input_frames),
        shown=f", {INPUTS} of them shown" if more > 0 else "",
        frame=target,
        true=TRUE * _known(samples),
    )
    return Made(figure(show.models, samples), caption)


@paper.paper_style()
@torch.no_grad()
def figure(
    models: Mapping[str, QueryGaussianModel],
    samples: Sequence[Sample],
) -> Figure:
    """Inputs, truth, render with PSNR, depths and error of the middle target of each sample."""
    scenes = [_rendered(models, sample) for sample in samples]
    errors = [color_error(r.rgb[0, 0], truth) for seen, truth in scenes for r in seen.values()]
    brightest = depth_range(torch.cat([error.flatten() for error in errors]))[1]
    titles = [title for title in TITLES if title != "true depth" or _known(samples)]
    columns = ceil(INPUTS / len(models)) + len(titles) - INPUTS
    rows = len(samples) * len(models)
    height, width = samples[0].inputs.cameras.size
    side = (WIDTH - 0.35) / columns
    drawn = new_figure((side * height / width + 0.04) * rows + 0.45)
    heights = [side * height / width] * rows + [0.07]
    *panels, scales = drawn.subplots(rows + 1, columns, height_ratios=heights)
    for number, sample in enumerate(samples):
        block = np.array(panels[number * len(models) : (number + 1) * len(models)])
        _scene(block, sample, *scenes[number], brightest, _known(samples))
        block[0, 0].set_ylabel(sample_name(sample, samples), labelpad=paper.PAD)
    for axis, title in zip(panels[0][::-1], titles, strict=False):
        axis.set_title(title)
    _scales(scales, brightest)
    return drawn


def _known(samples: Sequence[Sample]) -> bool:
    return any(sample.targets.depths is not None for sample in samples)


def _rendered(
    models: Mapping[str, QueryGaussianModel], sample: Sample
) -> tuple[dict[str, Rendering], Tensor]:
    """Rendering of the middle target by each model, and its photo (3, H, W)."""
    place = len(sample.target_frames) // 2
    seen = {}
    for name, model in models.items():
        device = next(model.parameters()).device
        gaussians = model(sample.inputs.to(device)).gaussians
        camera = sample.targets.cameras[:, place : place + 1].to(device)
        seen[name] = model.render(gaussians, camera)
    return seen, sample.targets.images[0, place]


def _scene(
    block: np.ndarray,
    sample: Sample,
    seen: Mapping[str, Rendering],
    truth: Tensor,
    brightest: float,
    column: bool,
) -> None:
    """One row for each model; inputs and truth beside them. column: whether true depth has one."""
    for axis in block.flat:
        blank_panel(axis)
    shown = [rgb_picture(image) for image in sample.inputs.images[0, :INPUTS]]
    for number, picture in enumerate(shown):
        picture_panel(block[number % len(block), number // len(block)], picture)
    first = block.shape[1] - 4 - column
    picture_panel(block[0, first], rgb_picture(truth))
    maps = [rendering.depth[0, 0].cpu() for rendering in seen.values()]
    depths = sample.targets.depths
    true = [] if depths is None else [depths[0, len(sample.target_frames) // 2].cpu()]
    near, far = depth_range(torch.cat([*true, *maps]))
    for line, found in zip(block, maps, strict=True):
        picture_panel(line[-2], depth_picture(found, near, far))
    for found in true:
        picture_panel(block[0, -3], depth_picture(found, near, far))
    tag(block[0, -3 if true else -2], f"{near:.2g} to {far:.2g}")
    for line, (name, rendering) in zip(block, seen.items(), strict=True):
        score = Psnr.column.shown(float(psnr(rendering.rgb[0, 0], truth.to(rendering.rgb))))
        picture_panel(line[first + 1], rgb_picture(rendering.rgb[0, 0]))
        tag(line[first + 1], f"{score} {Psnr.column.unit}")
        line[first + 1].set_ylabel(name, labelpad=paper.PAD)
        error = color_error(rendering.rgb[0, 0], truth)
        picture_panel(line[-1], error_picture(error, brightest))


def _scales(axes: Sequence[Axes], brightest: float) -> None:
    """Colour scales of the last columns, depth and error, below them."""
    *others, depth, error = axes
    for axis in others:
        axis.set_visible(False)
    for axis, end, colors, labels in (
        (depth, 1.0, DEPTH_MAP, ("near", "far")),
        (error, brightest, ERROR_MAP, ("0", f"{brightest:.2f}")),
    ):
        blank_panel(axis)
        axis.imshow(np.linspace(0, 1, 256)[None], cmap=colors, aspect="auto", extent=(0, end, 0, 1))
        axis.set_xticks([0, end], labels)
        axis.tick_params(length=0, pad=2)
        for label, side in zip(axis.get_xticklabels(), ("left", "right"), strict=True):
            label.set_horizontalalignment(side)
