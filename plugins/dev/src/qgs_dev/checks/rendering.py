"""Renderers: the background, depth, directions, features, and gradients in all that they read.

Finite differences are taken in a scene without jumps: every Gaussian contributes to every pixel,
far above `alpha_min`, none blocks what is behind it, and none changes its place in the order of
depths.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from qgs.containers import map_tensors, named_tensors
from qgs.contracts import Renderer
from qgs.geometry.harmonics import seen_colors
from qgs.types import SH_COUNTS
from qgs_dev.case import Case, expect
from qgs_dev.inputs import Inputs, Sizes, inputs_of, tracked_inputs
from qgs_dev.registry import check
from qgs_dev.trees import gradients, leaves, mapped, not_finite, scalar, tracked

CAMERA_TENSORS = ("c2w", "intrinsics")


@check({"renderer"})
def check_no_gaussians_give_the_background(case: Case) -> None:
    """Without Gaussians the image is the background, finite, with finite gradients."""
    module, inputs = case.lively(), tracked_inputs(case, inputs_of(case))
    empty = tracked(map_tensors(lambda x: x[:, :0], inputs["gaussians"]))
    colour = torch.tensor([0.1, 0.6, 0.9]).to(inputs["cameras"].c2w)
    out = module(empty, inputs["cameras"], colour)
    background = colour[:, None, None].expand_as(out.rgb)
    expect(torch.allclose(out.rgb, background, atol=1e-6), "the image is not the background")
    expect(not (out.alpha.any() or out.depth.any()), "alpha or depth is not zero")
    expect(not not_finite(out), "the rendering is not finite")
    broken = not_finite(gradients(scalar(out), leaves(empty) | leaves(inputs["cameras"])))
    expect(not broken, f"the gradient of {', '.join(broken)} is not finite")


@check({"renderer"})
def check_rendering_is_over_the_background(case: Case) -> None:
    """alpha is in [0, 1], and where it is below 1 the background shows by what is missing."""
    module, inputs = case.lively(), inputs_of(case)
    black, white = (torch.full((3,), v).to(inputs["cameras"].c2w) for v in (0.0, 1.0))
    dark, light = (module(*inputs.values(), background=colour) for colour in (black, white))
    low, high = dark.alpha.min().item(), dark.alpha.max().item()
    expect(low >= 0 and high <= 1 + 1e-5, f"alpha is {low:.4g} to {high:.4g}")
    off = (light.rgb - dark.rgb - (1 - dark.alpha)).abs().max().item()
    expect(off < 1e-4, f"the background shows by up to {off:.3g} more or less than 1 - alpha")


@check({"renderer"})
def check_depth_is_expected(case: Case) -> None:
    """Depth is the camera-frame z of what is hit, weighted by how much each hit contributes."""
    module, inputs = case.lively(), _inputs(case, seed=0, views=2)
    gaussians, cameras = inputs["gaussians"], inputs["cameras"]
    pair, near, far = (map_tensors(lambda x, k=k: x[:, k], gaussians) for k in ([0, -1], [0], [-1]))
    out = module(pair, cameras)
    front, behind = module(near, cameras).alpha, module(far, cameras).alpha
    behind = (1 - front) * behind
    eyes, axes = cameras.c2w[..., :3, 3], cameras.c2w[..., :3, 2]
    z = ((pair.means[:, None] - eyes[:, :, None]) * axes[:, :, None]).sum(-1)[..., None, None]
    expected = (front * z[:, :, :1] + behind * z[:, :, 1:]) / (front + behind).clamp_min(1e-6)
    off = (out.depth - expected)[front + behind > 0.05].abs().max().item()
    expect(off < 1e-3, f"depth is off by up to {off:.3g}")


@check({"renderer"})
def check_colours_depend_on_the_direction(case: Case) -> None:
    """With `sh`, every view is what Gaussians of the colours seen from there look like.

    Coefficients of zero change nothing.
    """
    module, inputs = case.lively(), inputs_of(case, Sizes(views=3))
    gaussians, cameras = inputs["gaussians"], inputs["cameras"]
    generator = torch.Generator().manual_seed(0)
    for count in SH_COUNTS:
        sh = 0.3 * torch.randn(*gaussians.opacities.shape, count, 3, generator=generator)
        varying = replace(gaussians, sh=sh.to(gaussians.means))
        out, colors = module(varying, cameras), seen_colors(varying, cameras)
        for view in range(cameras.shape[1]):
            fixed = replace(gaussians, sh=None, colors=colors[:, view])
            expected = module(fixed, cameras[:, [view]]).rgb
            off = (out.rgb[:, [view]] - expected).abs().max().item()
            seen = f"with {count} coefficients, view {view} is off by up to {off:.3g}"
            expect(off < 1e-4, seen)
    without, zeros = (replace(gaussians, sh=sh) for sh in (None, 0 * gaussians.sh))
    off = (module(without, cameras).rgb - module(zeros, cameras).rgb).abs().max().item()
    expect(off < 1e-4, f"coefficients of zero change the image by up to {off:.3g}")


@check({"renderer"})
def check_features_are_blended_as_colours(case: Case) -> None:
    """Features, of any number, are what colours of the same numbers give before black.

    They change nothing else, and Gaussians without features have none in their rendering.
    """
    module, inputs = case.lively(), inputs_of(case)
    gaussians, cameras = replace(inputs["gaussians"], sh=None), inputs["cameras"]
    black = torch.zeros(3).to(gaussians.means)
    plain, out = (module(replace(gaussians, features=None), cameras), module(gaussians, cameras))
    expect(plain.features is None, "Gaussians without features have some in their rendering")
    expect(out.features is not None, "Gaussians with features have none in their rendering")
    off = (out.rgb - plain.rgb).abs().max().item()
    expect(off < 1e-4, f"features change the colours by up to {off:.3g}")
    for first in (0, gaussians.features.shape[-1] - 3):
        shown = slice(first, first + 3)
        painted = replace(gaussians, colors=gaussians.features[..., shown], features=None)
        off = (out.features[:, :, shown] - module(painted, cameras, black).rgb).abs().max().item()
        expect(off < 1e-4, f"features are off by up to {off:.3g}")


@check({"renderer"})
def check_render_gradients_match_differences(case: Case) -> None:
    """The gradient of an image in the Gaussians agrees with finite differences."""
    module, inputs = case.lively(), _inputs(case, seed=0)
    given = tracked(inputs["gaussians"])
    total = _brightness(module(**{**inputs, "gaussians": given}))
    for name, gradient in gradients(total, {"gaussians": given}).items():
        _expect_changes(module, inputs, name, gradient)


@check({"renderer"})
def check_camera_gradients_match_differences(case: Case) -> None:
    """The gradient in poses and intrinsics agrees with finite differences, or is refused.

    A tensor of the cameras that `camera_gradients` does not name may raise ValueError when it
    requires a gradient.
    """
    assert issubclass(case.component, Renderer)
    declared = case.component.camera_gradients
    unknown = sorted(set(declared) - set(CAMERA_TENSORS))
    expect(not unknown, f"`camera_gradients` names {', '.join(unknown)}, no tensor of the cameras")
    module, inputs = case.lively(), _inputs(case, seed=1)
    for name in CAMERA_TENSORS:
        full = f"cameras.{name}"
        alone = mapped(inputs, lambda n, x, own=full: x.clone().requires_grad_(n == own))
        try:
            found = gradients(_brightness(module(*alone.values())), alone)
        except ValueError as error:
            seen = f"`camera_gradients` names {name}, but what requires one is refused: {error}"
            expect(name not in declared, seen)
            continue
        expect(full in found, f"`{name}` requires a gradient, is not refused, and gets none")
        _expect_changes(module, inputs, full, found[full])


def _inputs(case: Case, seed: int, views: int = 1) -> Inputs:
    """Cameras (1, V) before broad Gaussians (1, G), one behind the other."""
    inputs = inputs_of(case, Sizes(batch=1, queries=3, views=views), seed)
    gaussians, generator = inputs["gaussians"], torch.Generator().manual_seed(seed)
    count = gaussians.means.shape[1]

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        numbers = low + (high - low) * torch.rand(1, count, *shape, generator=generator)
        return numbers.to(gaussians.means)

    means = uniform(-0.25, 0.25, 3)
    means[..., 2] = 1.6 + 0.13 * torch.arange(count).to(means)
    broad = replace(
        gaussians, means=means, scales=uniform(0.85, 1.7, 3), opacities=uniform(0.3, 0.5)
    )
    broad = replace(broad, colors=uniform(0.5, 1, 3))  # above 0 with `sh` too
    return {**inputs, "gaussians": broad}


def _expect_changes(module: Any, inputs: Inputs, name: str, gradient: Tensor) -> None:
    """Moved there and back, one input changes the image as its `gradient` says."""
    for there, back, expected in _moves(name, leaves(inputs)[name], gradient):
        first, second = (
            _brightness(module(*mapped(inputs, lambda n, x, m=x: m if n == name else x).values()))
            for x in (there, back)
        )
        measured = ((first - second) / 2).item()
        close = abs(measured - expected) <= 1e-6 + 0.03 * abs(expected)
        seen = f"changes the image by {measured:.4g}, by its gradient {expected:.4g}"
        expect(close, f"a step of `{name}` {seen}")


def _moves(name: str, x: Tensor, gradient: Tensor) -> Iterator[tuple[Tensor, Tensor, float]]:
    """A tensor moved there, and back, and by how much the image changes by its `gradient`.

    Gaussians along the gradient and channel by channel, cameras along and about each of their axes,
    focal lengths and principal points one by one.
    """
    if name == "cameras.c2w":
        for index in range(6):
            motion = torch.zeros(4, 4).to(x)
            axis, one, other = index % 3, (index + 1) % 3, (index + 2) % 3
            if index < 3:
                motion[axis, 3] = 0.02
            else:
                motion[other, one], motion[one, other] = 0.02, -0.02  # radians
            there, back = (x @ torch.linalg.matrix_exp(sign * motion) for sign in (1, -1))
            yield there, back, ((x @ motion) * gradient).sum().item()
        return
    channels = torch.eye(x[0, 0].numel()).to(x).reshape(-1, *x[0, 0].shape)
    steps = [0.5 * channel for channel in channels]  # pixels
    if name.startswith("gaussians"):
        steps = [0.01 * channel for channel in channels]
        steps.append(0.03 * gradient / gradient.norm().clamp_min(1e-12))
    for step in steps:
        yield x + step, x - step, (gradient * step).sum().item()


def _brightness(rendering: Any) -> Tensor:
    """A smooth number of a rendering: of its colours, of alpha, of depth and of features."""
    y = torch.linspace(-1, 1, rendering.rgb.shape[-2], dtype=torch.float64)[:, None]
    x = torch.linspace(-1, 1, rendering.rgb.shape[-1], dtype=torch.float64)
    rgb, alpha, depth, features = (x.double().cpu() for _, x in named_tensors(rendering))
    pictures = (features * torch.cos(x - y)).mean() + (features * torch.sin(x + 3 * y)).mean()
    pictures = pictures + (rgb * torch.cos(2 * x + y)).mean() + (rgb * torch.sin(x - 2 * y)).mean()
    return pictures + (alpha * torch.cos(x + 2 * y)).mean() + (depth * torch.sin(2 * x - y)).mean()
