"""Every tensor that a file of losses can hold, computed by our loss components.

`refssim` means SSIM with zero padding ("same"), as in training here.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

import torch
from qgs_locus.fields import CENTER
from qgs_locus.visibility import AnchorVisibility
from torch import Tensor

from published.files import EXPECTED, GoldenFile, GoldenFileError
from published.options import ReleasedOptions
from qgs.containers import TensorContainer, map_tensors
from qgs.contracts import Loss
from qgs.geometry.transforms import to_pixels
from qgs.losses import Mask, Opacity, Photometric, Visibility, view_visibility
from qgs.metrics.images import psnr
from qgs.types import Cameras, Gaussians, LayerPrediction, QueryState, Rendering, Views

RGB_TERM = {"tokengs": "loss_rgb", "locusgs": "loss_mse"}


@dataclass(frozen=True)
class LossInputs(TensorContainer):
    """Inputs of the losses, B scenes. has_mask: (B,), whether a scene's mask is supervised."""

    prediction: LayerPrediction
    rendering: Rendering
    target: Views
    has_mask: Tensor

    def scenes(self) -> Iterator[Self]:
        """Each scene as a batch of one."""
        for index in range(len(self.has_mask)):
            yield map_tensors(lambda x, one=slice(index, index + 1): x[one], self)

    def value(self, loss: Loss) -> Tensor:
        """The only term of `loss`."""
        (term,) = loss(self.prediction, self.rendering, self.target, self.target).values()
        return term


def read_inputs(golden: GoldenFile, images: bool) -> LossInputs:
    """The inputs of a loss file; outside its mask the truth is white, as in both releases.

    images: whether losses of images are expected; otherwise what the file lacks is blank.
    """
    points = golden.input("points")
    cameras = Cameras(golden.input("c2w"), golden.input("intrinsics"), golden.size)

    def read(name: str, *shape: int) -> Tensor:
        return golden.input(name) if images or name in golden.tensors else torch.ones(shape)

    views = cameras.c2w.shape[:2]
    colours = (*views, 3, *golden.size)
    pixels = (*views, 1, *golden.size)
    opacity = read("opacity", *points.shape[:2], 1)
    rgb = read("images_pred", *colours)
    alpha = read("alphas_pred", *pixels)
    masks = read("masks_gt", *pixels)
    truth = read("images_gt", *colours) * masks + (1 - masks)
    quats = torch.zeros(*points.shape[:2], 4)
    gaussians = Gaussians(points, torch.ones_like(points), quats, opacity[..., 0], points)
    return LossInputs(
        LayerPrediction(gaussians, QueryState(points, {CENTER: points})),
        Rendering(rgb, alpha, torch.zeros_like(alpha)),
        Views(truth, cameras, masks),
        read("has_mask", len(points)),
    )


def loss_tensors(golden: GoldenFile) -> dict[str, Tensor]:
    """All tensors that the file may hold, by name; whole losses only as far as they are in it."""
    wholes = [
        (release, ssim)
        for release in RGB_TERM
        for ssim in ("nossim", "refssim")
        if any(name.startswith(f"{EXPECTED}{release}.{ssim}.") for name in golden.tensors)
    ]
    inputs = read_inputs(golden, images=bool(wholes))
    cameras = inputs.target.cameras
    found = {
        "cam_view": cameras.w2c.transpose(-1, -2),
        f"{EXPECTED}tokengs.means2d": _pixels(inputs, golden.tensors.get("cam_view")),
    }
    for threshold in _thresholds(golden):
        found |= _visibility(inputs, threshold)
    for release, ssim in wholes:
        options = ReleasedOptions(golden.options(f"{release}_options"))
        terms = _whole_loss(inputs, release, options, ssim)
        found |= {f"{EXPECTED}{release}.{ssim}.{name}": term for name, term in terms.items()}
    return found


def _pixels(inputs: LossInputs, cam_view: Tensor | None) -> Tensor:
    """Pixels of the points; near z = 0 they depend on the last bit of the file's view matrix."""
    cameras = inputs.target.cameras
    points = inputs.prediction.gaussians.means
    seen = cameras.w2c.transpose(-1, -2) if cam_view is None else cam_view.to(points)
    camera_points = points[:, None] @ seen[..., :3, :3] + seen[..., 3:, :3]
    return to_pixels(camera_points, cameras.intrinsics)


def _thresholds(golden: GoldenFile) -> list[str]:
    """The names of the thresholds in the file: noclamp, clamp1, clamp0p25, ..."""
    pattern = re.compile(r"visibility.*\.(noclamp|clamp[\dp]+)$")
    matches = (pattern.search(name) for name in golden.tensors)
    return sorted({match[1] for match in matches if match})


def _clamp(threshold: float | str) -> float | None:
    """The clamp that a threshold stands for, by value (0 is none) or by name."""
    if isinstance(threshold, str):
        digits = threshold.removeprefix("clamp").replace("p", ".")
        threshold = 0.0 if threshold == "noclamp" else float(digits)
    return threshold or None


def _visibility(inputs: LossInputs, threshold: str) -> dict[str, Tensor]:
    """Per point, per scene and in all; in all views and in the first alone."""
    clamp = _clamp(threshold)
    points = inputs.prediction.gaussians.means
    guard = AnchorVisibility.Config().z_guard
    found = {}
    for suffix, views in (("", slice(None)), ("_view0", slice(1))):
        cameras = inputs.target.cameras[:, views]
        gaussian = view_visibility(points, cameras, clamp=clamp)
        anchor = view_visibility(points, cameras, clamp=clamp, z_guard=guard)
        found |= {
            f"tokengs.visibility_per_point{suffix}": gaussian,
            f"tokengs.visibility_per_scene{suffix}": gaussian.mean(1),
            f"locusgs.anchor_visibility_per_point{suffix}": anchor,
            f"locusgs.anchor_visibility_per_scene{suffix}": anchor.mean(1),
            f"locusgs.anchor_visibility{suffix}": anchor.mean(),
        }
    component = AnchorVisibility(AnchorVisibility.Config(weight=1.0, clamp=clamp))
    found["locusgs.anchor_visibility"] = inputs.value(component)
    return {f"{EXPECTED}{name}.{threshold}": value for name, value in found.items()}


def _whole_loss(
    inputs: LossInputs, release: str, options: ReleasedOptions, ssim: str
) -> dict[str, Tensor]:
    """Every term of a release's loss, unweighted, and their weighted sum; per scene and in all."""
    options.only({"rgb_loss_type": "l2", "lambda_rgb": 1.0, "lambda_lpips": 0.0})
    per_scene = {}
    total_per_scene = torch.zeros(len(inputs.has_mask))
    for name, weight, loss in _terms(release, options, ssim):
        values = torch.stack([scene.value(loss) for scene in inputs.scenes()])
        per_scene[name] = values * inputs.has_mask if name == "loss_mask" else values
        total_per_scene = total_per_scene + weight * per_scene[name]
    per_scene["loss"] = total_per_scene
    per_scene["psnr"] = psnr(inputs.rendering.rgb, inputs.target.images).mean(1)
    found = {name: values.mean() for name, values in per_scene.items()}
    found |= {f"{name}_per_scene": values for name, values in per_scene.items()}
    if "lambda_opacity" in options:
        found["loss_opacity"] = inputs.value(Opacity(Opacity.Config(weight=1.0)))
        found["loss"] = found["loss"] + options["lambda_opacity"] * found["loss_opacity"]
    return found


def _terms(release: str, options: ReleasedOptions, ssim: str) -> Iterator[tuple[str, float, Loss]]:
    """Name, published weight and unweighted component of each term that is a sum over scenes."""
    clamp = _clamp(options["visibility_distance_threshold"])
    yield RGB_TERM[release], 1.0, Photometric(Photometric.Config(ssim_weight=0.0))
    yield "loss_mask", options["lambda_mask"], Mask(Mask.Config(weight=1.0))
    visibility = Visibility(Visibility.Config(weight=1.0, clamp=clamp))
    yield "loss_visibility", options["lambda_visibility"], visibility
    ssim_weight = _ssim_weight(options, ssim)
    if ssim_weight:
        ssim_loss = Photometric.Config(mse_weight=0.0, ssim_weight=1.0, padding="same")
        yield "loss_ssim", ssim_weight, Photometric(ssim_loss)


def _ssim_weight(options: ReleasedOptions, ssim: str) -> float:
    """The option is a number (0 for `nossim`), or text such as "0 (nossim) / 0.2 (refssim)"."""
    text = options["lambda_ssim"]
    if not isinstance(text, str):
        return 0.0 if ssim == "nossim" else float(options["lambda_ssim"])
    match = re.search(rf"([\d.]+) \({ssim}\)", text)
    if not match:
        raise GoldenFileError(f"the option lambda_ssim is {text!r}; it tells no weight of {ssim}")
    return float(match[1])
