"""Tensors of a golden file of losses, computed by the loss components of qgs.

`refssim` in a name means SSIM with zero padding ("same"), as qgs uses in training.
"""

from collections.abc import Iterator
from typing import Any

import torch
from qgs_dev.vocabulary import scene
from qgs_locus.fields import CENTER
from qgs_locus.visibility import AnchorVisibility
from torch import Tensor

from published.files import GoldenFile, Tensors
from qgs.contracts import Loss
from qgs.geometry.transforms import to_pixels
from qgs.losses import Mask, Opacity, Photometric, Visibility, view_visibility
from qgs.metrics.images import psnr
from qgs.types import Cameras, Gaussians, LayerPrediction, QueryState, Rendering, Views

RGB_TERM = {"tokengs": "loss_rgb", "locusgs": "loss_mse"}
SSIM_WEIGHTS = {"nossim": 0.0, "refssim": 0.2}
CLAMPS = {"noclamp": None, "clamp1": 1.0, "clamp0p25": 0.25}
"""Thresholds of the visibility loss, by their names in the golden file."""

Options = dict[str, Any]
"""Published options by name."""
Given = tuple[LayerPrediction, Rendering, Views]
"""Inputs of a loss: prediction, rendering and true views of B scenes."""


def read_inputs(golden: GoldenFile) -> Given:
    """Return the inputs of the losses. True images are white outside their mask, as published."""
    points = golden.input("points")
    images = golden.input("images_gt")
    size = (images.shape[-2], images.shape[-1])
    cameras = Cameras(golden.input("c2w"), golden.input("intrinsics"), size)
    alpha = golden.input("alphas_pred")
    masks = golden.input("masks_gt")
    quats = torch.zeros(*points.shape[:2], 4)
    opacity = golden.input("opacity")[..., 0]
    gaussians = Gaussians(points, torch.ones_like(points), quats, opacity, points)
    return (
        LayerPrediction(gaussians, QueryState(points, {CENTER: points})),
        Rendering(golden.input("images_pred"), alpha, torch.zeros_like(alpha)),
        Views(images * masks + (1 - masks), cameras, masks),
    )


def value(loss: Loss, given: Given) -> Tensor:
    """Return the value of `loss`, which must have exactly one term."""
    (term,) = loss(*given, given[2]).values()
    return term


def loss_tensors(golden: GoldenFile) -> Tensors:
    """Compute all tensors that a golden file of losses may hold, by name."""
    given = read_inputs(golden)
    prediction, _, target = given
    points = prediction.gaussians.means
    seen = target.cameras.w2c.transpose(-1, -2)
    # Near z = 0, pixels depend on the last bit of the file's view matrix.
    theirs = golden.tensors["cam_view"].to(points)
    camera_points = points[:, None] @ theirs[..., :3, :3] + theirs[..., 3:, :3]
    found = {"tokengs.means2d": to_pixels(camera_points, target.cameras.intrinsics)}
    for name, clamp in CLAMPS.items():
        of_clamp = visibility(points, target.cameras, clamp)
        component = AnchorVisibility(AnchorVisibility.Config(weight=1.0, clamp=clamp))
        of_clamp["locusgs.anchor_visibility"] = value(component, given)
        found |= {f"{kind}.{name}": x for kind, x in of_clamp.items()}
    has_mask = golden.input("has_mask")
    for release in RGB_TERM:
        options = golden.config[f"{release}_options"]
        for ssim, weight in SSIM_WEIGHTS.items():
            terms = whole_loss(given, has_mask, release, options, weight)
            found |= {f"{release}.{ssim}.{name}": term for name, term in terms.items()}
    return {"cam_view": seen, **{f"expected.{name}": x for name, x in found.items()}}


def visibility(points: Tensor, cameras: Cameras, clamp: float | None) -> Tensors:
    """Return visibility losses by name: for each point, for each scene and in total.

    Each is computed for all views, and for the first view only.
    """
    guard = AnchorVisibility.Config().z_guard
    found = {}
    for suffix, views in (("", slice(None)), ("_view0", slice(1))):
        gaussian = view_visibility(points, cameras[:, views], clamp=clamp)
        anchor = view_visibility(points, cameras[:, views], clamp=clamp, z_guard=guard)
        found |= {
            f"tokengs.visibility_per_point{suffix}": gaussian,
            f"tokengs.visibility_per_scene{suffix}": gaussian.mean(1),
            f"locusgs.anchor_visibility_per_point{suffix}": anchor,
            f"locusgs.anchor_visibility{suffix}": anchor.mean(),
        }
    return found


def whole_loss(
    given: Given, has_mask: Tensor, release: str, options: Options, ssim: float
) -> Tensors:
    """Return the unweighted terms and the weighted sum of a published loss, by name.

    Both are given for each scene and in total. has_mask: (B,), True for scenes whose mask is
    supervised. ssim: weight of the SSIM term.
    """
    scenes = [scene(given, n) for n in range(len(has_mask))]
    per_scene = {}
    total = torch.zeros(len(has_mask))
    for name, weight, loss in terms_of(release, options, ssim):
        values = torch.stack([value(loss, one) for one in scenes])
        per_scene[name] = values * has_mask if name == "loss_mask" else values
        total = total + weight * per_scene[name]
    _, rendering, target = given
    per_scene |= {"loss": total, "psnr": psnr(rendering.rgb, target.images).mean(1)}
    found = {name: values.mean() for name, values in per_scene.items()}
    found |= {f"{name}_per_scene": values for name, values in per_scene.items()}
    if "lambda_opacity" in options:
        found["loss_opacity"] = value(Opacity(Opacity.Config(weight=1.0)), given)
        found["loss"] = found["loss"] + options["lambda_opacity"] * found["loss_opacity"]
    return found


def terms_of(release: str, options: Options, ssim: float) -> Iterator[tuple[str, float, Loss]]:
    """Yield name, published weight and unweighted loss component of each term."""
    yield RGB_TERM[release], 1.0, Photometric(Photometric.Config(ssim_weight=0.0))
    yield "loss_mask", options["lambda_mask"], Mask(Mask.Config(weight=1.0))
    # 0 stands for none.
    clamp = options["visibility_distance_threshold"] or None
    seen = Visibility(Visibility.Config(weight=1.0, clamp=clamp))
    yield "loss_visibility", options["lambda_visibility"], seen
    if ssim:
        ssim_loss = Photometric.Config(mse_weight=0.0, ssim_weight=1.0, padding="same")
        yield "loss_ssim", ssim, Photometric(ssim_loss)
