"""Figure: views that a model never saw, beside the truth, with depth and error."""

from collections.abc import Mapping, Sequence
from math import ceil

import numpy as np
import torch
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from qgs.data.sampling import Sample
from qgs.drawing.images import DEPTH_MAP, Picture, depth_picture, depth_range, rgb_picture
from qgs.metrics.images import Psnr, psnr
from qgs.model import QueryGaussianModel
from qgs.types import Rendering
from qgs_viewer.figures.exhibits import Exhibition, sample_name
from qgs_viewer.figures.paper import (
    WIDTH,
    Made,
    blank_panel,
    new_figure,
    paper_style,
    picture_panel,
    row_label,
    tag,
)

SCENES = 3
INPUTS = 2
"""Input views of each scene that are shown."""
TITLES = ("error", "depth", "render", "truth", *["inputs"] * INPUTS)
"""Of columns, from the right."""
ERROR_MAP = "magma"
BRIGHTEST = 0.99
"""Quantile of all errors at which the colour scale ends."""


def made(show: Exhibition) -> Made:
    """See `figure`."""
    samples, first = show.samples[:SCENES], show.samples[0]
    target = first.label(_middle(first.target_frames))
    more = len(first.input_frames) - INPUTS
    caption = (
        f"Novel views of {', '.join(sample_name(s, samples) for s in samples)}, each from "
        f"{len(first.input_frames)} photos{f', {INPUTS} of them shown' if more > 0 else ''}. Of "
        f"each the middle target is shown (in the first, frame {target}), with PSNR. Depth: "
        "light is near, dark is far; each map has the range told in it (2nd to 98th percentile, "
        "units of the models' world); grey is nothing. Error: mean over channels of the absolute "
        "difference from the truth, one scale in all. Pixels as rendered."
    )
    return Made(figure(show.models, samples, show.depths[:SCENES]), caption)


@torch.no_grad()
def figure(
    models: Mapping[str, QueryGaussianModel],
    samples: Sequence[Sample],
    depths: Sequence[Tensor | None],
) -> Figure:
    """Inputs, truth, render with PSNR, depth and error of the middle target of each sample.

    depths: for each sample the true depth (T, 1, H, W) of its targets, where known.
    """
    scenes = [_rendered(models, sample) for sample in samples]
    errors = [error_map(r.rgb[0, 0], truth) for seen, truth in scenes for r in seen.values()]
    brightest = float(torch.quantile(torch.cat([e.flatten() for e in errors]), BRIGHTEST))
    columns, rows = ceil(INPUTS / len(models)) + 4, len(samples) * len(models)
    height, width = samples[0].inputs.cameras.size
    side = (WIDTH - 0.35) / columns
    with paper_style():
        drawn = new_figure((side * height / width + 0.04) * rows + 0.45)
        heights = [side * height / width] * rows + [0.07]
        *panels, scales = drawn.subplots(rows + 1, columns, height_ratios=heights)
        for number, (sample, depth) in enumerate(zip(samples, depths, strict=True)):
            block = np.array(panels[number * len(models) : (number + 1) * len(models)])
            _scene(block, sample, depth, *scenes[number], brightest)
            row_label(block[0, 0], sample_name(sample, samples))
        for axis, title in zip(panels[0][::-1], TITLES, strict=False):
            axis.set_title(title)
        _scales(scales, brightest)
    return drawn


def error_map(image: Tensor, truth: Tensor) -> Tensor:
    """Mean over channels of |image - truth|, (3, H, W) each -> (H, W)."""
    return (image - truth.to(image)).abs().mean(0).float().cpu()


def error_picture(error: Tensor, brightest: float) -> Picture:
    """An error map (H, W) from 0 (dark) to `brightest`."""
    shade = (error / max(brightest, 1e-12)).clamp(0, 1).numpy()
    return (colormaps[ERROR_MAP](shade)[..., :3] * 255).round().astype(np.uint8)


def _middle(frames: Sequence[int]) -> int:
    return frames[len(frames) // 2]


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
    depth: Tensor | None,
    seen: Mapping[str, Rendering],
    truth: Tensor,
    brightest: float,
) -> None:
    """One row for each model; inputs and truth beside them."""
    for axis in block.flat:
        blank_panel(axis)
    shown = [rgb_picture(image) for image in sample.inputs.images[0, :INPUTS]]
    for number, picture in enumerate(shown):
        picture_panel(block[number % len(block), number // len(block)], picture)
    first = block.shape[1] - 4
    picture_panel(block[0, first], rgb_picture(truth))
    if depth is not None and len(block) > 1:
        _depth(block[1, first], depth[len(sample.target_frames) // 2], "true, ")
    for line, (name, rendering) in zip(block, seen.items(), strict=True):
        score = Psnr.column.shown(float(psnr(rendering.rgb[0, 0], truth.to(rendering.rgb))))
        picture_panel(line[first + 1], rgb_picture(rendering.rgb[0, 0]))
        tag(line[first + 1], f"{score} {Psnr.column.unit}")
        row_label(line[first + 1], name)
        _depth(line[first + 2], rendering.depth[0, 0])
        error = error_map(rendering.rgb[0, 0], truth)
        picture_panel(line[first + 3], error_picture(error, brightest))


def _depth(axis: Axes, depth: Tensor, words: str = "") -> None:
    """Depth (1, H, W) in colours of its own range, which is told."""
    near, far = depth_range(depth)
    picture_panel(axis, depth_picture(depth, near, far))
    tag(axis, f"{words}{near:.2g} to {far:.2g}")


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
