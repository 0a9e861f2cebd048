"""What models and predictions look like when they are printed, and in a notebook."""

from html import escape

import torch
from torch import nn

from qgs.analysis.pipeline import pipeline_svg
from qgs.composer.slots import LAYER_SLOTS, SUBLAYER_SLOTS
from qgs.contracts import LearnedQueries
from qgs.model import QueryGaussianModel
from qgs.types import Cameras, Prediction

SIDE = 192  # pixels of the picture of a prediction
_OUTSIDE = 0.04  # share of the Gaussians that it may leave out at its sides
_WIDEST = 1.2  # tangent of half the widest view


def parameter_counts(model: QueryGaussianModel) -> dict[str, int]:
    """Component to its number of parameters, decoder layers summed by slot.

    `decoder.layer` has what is not of its sublayers.
    """
    sublayers = {
        f"decoder.{slot}": sum(map(_count, modules))
        for slot in SUBLAYER_SLOTS
        if (modules := [getattr(layer, slot) for layer in model.decoder if hasattr(layer, slot)])
    }
    return {
        "encoder": _count(model.encoder),
        "queries": _count(model.queries),
        "decoder.layer": _count(model.decoder) - sum(sublayers.values()),
        **sublayers,
        "decoder.refinement": _count(model.refinements),
        "head": _count(model.head),
        "centers": _count(model.centers),
    }


def _count(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def model_text(model: QueryGaussianModel) -> str:
    """Sizes, then a line for each slot: its component and number of parameters."""
    rows = _rows(model)
    wide = [max(len(row[column]) for row in rows) for column in range(3)]
    lines = [f"  {slot:<{wide[0]}}  {kind:<{wide[1]}}  {n:>{wide[2]}}" for slot, kind, n in rows]
    return "\n".join([_heading(model), *(line.rstrip() for line in lines)])


def model_html(model: QueryGaussianModel) -> str:
    """A picture of the way from views to Gaussians, and the same as a table."""
    rows = ["".join(f"<td>{escape(cell)}</td>" for cell in row) for row in _rows(model)]
    kinds = {slot: kind for slot, kind, _ in _rows(model)}
    learned = isinstance(model.queries, LearnedQueries)
    picture = pipeline_svg(kinds, parameter_counts(model), model.depth, learned)
    body = "".join(f"<tr>{row}</tr>" for row in rows)
    head = "<tr><th>slot</th><th>component</th><th>parameters</th></tr>"
    return f"<p>{escape(_heading(model))}</p>{picture}<table>{head}{body}</table>"


def _heading(model: QueryGaussianModel) -> str:
    tree = (model.recipe or {}).get("model", {})
    options = {**tree.get("queries", {}), **tree.get("head", {})}
    told = [f"{_count(model):,} parameters", f"{model.depth} decoder layers"]
    if {"count", "gaussians_per_query"} <= options.keys():
        told.append(f"{options['count']:,} queries of {options['gaussians_per_query']} Gaussians")
    device = next((parameter.device for parameter in model.parameters()), "cpu")
    return f"{type(model).__name__}: {', '.join(told)}, on {device}"


def _rows(model: QueryGaussianModel) -> list[tuple[str, str, str]]:
    """Slot, types of its components (without a recipe their classes) and parameters."""
    counts = {name: f"{count:,}" for name, count in parameter_counts(model).items()}
    counts |= {"supervision": "", "renderer": ""}
    kinds = {name: _types(model, name.removeprefix("decoder.")) for name in counts}
    return [(name, ", ".join(dict.fromkeys(kinds[name])), count) for name, count in counts.items()]


def _types(model: QueryGaussianModel, slot: str) -> list[str]:
    """What stands in a slot, in one of the decoder by layer."""
    tree = model.recipe["model"] if model.recipe else None
    if slot not in LAYER_SLOTS:
        return [tree[slot]["type"] if tree else type(getattr(model, slot)).__name__]
    if tree is None:
        modules = model.refinements if slot == "refinement" else model.decoder
        if slot in SUBLAYER_SLOTS:
            modules = [getattr(layer, slot) for layer in model.decoder if hasattr(layer, slot)]
        return [type(module).__name__ for module in modules]
    own = tree["decoder"].get("layers", {})
    layers = [own.get(str(index), {}) for index in range(model.depth)]
    chosen = [layer.get(slot, tree["decoder"].get(slot)) for layer in layers]
    return [one["type"] for one in chosen if one]


@torch.no_grad()
def prediction_png(prediction: Prediction) -> bytes | None:
    """The first scene and its depth from the origin of its world; None if nothing lies before it.

    There stands the first input camera, or the mean of all, whichever the recipe says.
    """
    from qgs.drawing.images import depth_picture, depth_range, png_bytes, rgb_picture, side_by_side
    from qgs.renderers import AutoRenderer

    gaussians, means = prediction.gaussians[:1], prediction.gaussians.means[0].float()
    if means.is_meta or not means.isfinite().all():
        return None
    before = means[(means[:, 2] > 0) & (gaussians.opacities[0] > 0.05)]
    if len(before) == 0:
        return None
    slopes = (before[:, :2] / before[:, 2:]).abs().amax(-1)
    focal = SIDE / 2 / float(slopes.quantile(1 - _OUTSIDE).clamp(0.1, _WIDEST))
    lens = means.new_tensor([[[focal, focal, SIDE / 2, SIDE / 2]]])
    camera = Cameras(torch.eye(4).to(means)[None, None], lens, (SIDE, SIDE))
    seen = AutoRenderer(AutoRenderer.Config())(gaussians, camera)
    depth = depth_picture(seen.depth[0, 0], *depth_range(seen.depth))
    return png_bytes(side_by_side([rgb_picture(seen.rgb[0, 0]), depth]))
