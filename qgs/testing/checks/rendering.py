"""Renderings of a smooth scene: depth, and gradients in Gaussians, poses and intrinsics.

The scene is one without jumps, so that differences mean something: every Gaussian contributes to
every pixel, far above `alpha_min`, none blocks what is behind it, and none changes its place in
the order of depths.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from qgs.contracts import Renderer
from qgs.testing.case import Case
from qgs.testing.faults import expect
from qgs.testing.registry import check
from qgs.testing.subjects import Inputs, Sizes, inputs_of
from qgs.testing.trees import floating, mapped, tracked

Move = Callable[[float], Tensor]
"""A tensor, moved by so many times a step."""

ALONG_GRADIENT = 0.03
"""Length of the step of all numbers of a tensor along their gradient."""
CHANNEL = 0.01
"""Step of one channel of all Gaussians."""
POSE = 0.02
"""World units, and radians."""
LENS = 0.5
"""Pixels."""

HIT = 0.05
"""Alpha above which a depth is looked at."""

CAMERA_TENSORS = ("c2w", "intrinsics")


@check({"renderer"})
def check_depth_is_expected(case: Case) -> None:
    """Depth is the camera-frame z of what is hit, weighted by how much each hit contributes."""
    module, inputs = case.lively(), _inputs(case, seed=0, views=2)
    gaussians, cameras = inputs["gaussians"], inputs["cameras"]
    pair, near, far = (mapped(gaussians, lambda _, x, k=k: x[:, k]) for k in ([0, -1], [0], [-1]))
    out = module(pair, cameras)
    front, behind = module(near, cameras).alpha, module(far, cameras).alpha
    behind = (1 - front) * behind
    eyes, axes = cameras.c2w[..., :3, 3], cameras.c2w[..., :3, 2]
    z = ((pair.means[:, None] - eyes[:, :, None]) * axes[:, :, None]).sum(-1)[..., None, None]
    expected = (front * z[:, :, :1] + behind * z[:, :, 1:]) / (front + behind).clamp_min(1e-6)
    off = (out.depth - expected)[front + behind > HIT].abs().max().item()
    expect(off < 1e-3, f"depth is off by up to {off:.3g}")


@check({"renderer"})
def check_render_gradients_match_differences(case: Case) -> None:
    """The gradient of an image in the Gaussians agrees with finite differences."""
    module = case.lively()
    for seed, moves in ((0, _along_gradient), (1, _channel_by_channel)):
        inputs = _inputs(case, seed)
        given = {n: x for n, x in floating(tracked(inputs)).items() if n.startswith("gaussians")}
        total = _brightness(module(*mapped(inputs, lambda n, x, g=given: g.get(n, x)).values()))
        slopes = torch.autograd.grad(total, list(given.values()))
        for (name, x), slope in zip(given.items(), slopes, strict=True):
            for move, told in moves(x, slope):
                _expect_change(module, inputs, name, move, told)


@check({"renderer"})
def check_camera_gradients_match_differences(case: Case) -> None:
    """The gradient in poses and intrinsics agrees with finite differences, or is refused.

    A tensor of the cameras that `camera_gradients` does not name may raise ValueError when it
    requires a gradient.
    """
    declared = _declared(case)
    unknown = sorted(set(declared) - set(CAMERA_TENSORS))
    expect(not unknown, f"`camera_gradients` names {', '.join(unknown)}, no tensor of the cameras")
    module, inputs = case.lively(), _inputs(case, seed=1)
    for name, moves in zip(CAMERA_TENSORS, (_pose_moves, _lens_moves), strict=True):
        try:
            slope = _slope(module, inputs, f"cameras.{name}")
        except ValueError as error:
            told = f"`camera_gradients` names {name}, but what requires one is refused: {error}"
            expect(name not in declared, told)
            continue
        expect(slope is not None, f"`{name}` requires a gradient, is not refused, and gets none")
        assert slope is not None
        for move, change in moves(getattr(inputs["cameras"], name), slope):
            _expect_change(module, inputs, f"cameras.{name}", move, change)


def _declared(case: Case) -> tuple[str, ...]:
    component = case.component
    assert issubclass(component, Renderer)
    return component.camera_gradients


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
    return {**inputs, "gaussians": broad}


def _slope(module: Any, inputs: Inputs, name: str) -> Tensor | None:
    """The gradient in one input that alone requires one."""
    alone = mapped(inputs, lambda n, x: x.detach().clone().requires_grad_(n == name))
    total = _brightness(module(*alone.values()))
    if not total.requires_grad:
        return None
    return torch.autograd.grad(total, floating(alone)[name], allow_unused=True)[0]


def _along_gradient(x: Tensor, slope: Tensor) -> Iterator[tuple[Move, float]]:
    step = ALONG_GRADIENT * slope / slope.norm().clamp_min(1e-12)
    yield (lambda s: x + s * step), (slope * step).sum().item()


def _channel_by_channel(x: Tensor, slope: Tensor) -> Iterator[tuple[Move, float]]:
    """A move of all Gaussians (1, G, ...) in each number of theirs."""
    for one in _unit_vectors(x[0, 0]):
        yield (lambda s, d=CHANNEL * one: x + s * d), CHANNEL * (slope * one).sum().item()


def _pose_moves(c2w: Tensor, slope: Tensor) -> Iterator[tuple[Move, float]]:
    """The cameras moved along, and turned about, each of their own axes."""
    for generator in (*_shifts(), *_turns()):
        motion = POSE * generator.to(c2w)
        move = lambda s, m=motion: c2w @ torch.linalg.matrix_exp(s * m)  # noqa: E731
        yield move, ((c2w @ motion) * slope).sum().item()


def _lens_moves(intrinsics: Tensor, slope: Tensor) -> Iterator[tuple[Move, float]]:
    """Each focal length and each coordinate of the principal point."""
    for one in _unit_vectors(intrinsics[0, 0]):
        yield (lambda s, d=LENS * one: intrinsics + s * d), LENS * (slope * one).sum().item()


def _unit_vectors(like: Tensor) -> Iterator[Tensor]:
    yield from torch.eye(like.numel()).to(like).reshape(-1, *like.shape)


def _shifts() -> Iterator[Tensor]:
    """Generators (4, 4) of translations."""
    for axis in range(3):
        generator = torch.zeros(4, 4)
        generator[axis, 3] = 1
        yield generator


def _turns() -> Iterator[Tensor]:
    """Generators (4, 4) of rotations."""
    for axis in range(3):
        generator = torch.zeros(4, 4)
        one, other = (axis + 1) % 3, (axis + 2) % 3
        generator[other, one], generator[one, other] = 1, -1
        yield generator


def _expect_change(module: Any, inputs: Inputs, name: str, move: Move, told: float) -> None:
    """Moved there and back, one input changes the image as its gradient tells."""

    def shifted(sign: int) -> Tensor:
        at = mapped(inputs, lambda n, x: (move(sign) if n == name else x).detach())
        return _brightness(module(*at.values()))

    measured = ((shifted(1) - shifted(-1)) / 2).item()
    close = abs(measured - told) <= 1e-6 + 0.03 * abs(told)
    seen = f"a step of `{name}` changes the image by {measured:.4g}, by its gradient {told:.4g}"
    expect(close, seen)


def _brightness(rendering: Any) -> Tensor:
    """A smooth number of a rendering: of its colours, of alpha and of depth."""
    y = torch.linspace(-1, 1, rendering.rgb.shape[-2], dtype=torch.float64)[:, None]
    x = torch.linspace(-1, 1, rendering.rgb.shape[-1], dtype=torch.float64)
    rgb, alpha, depth = (
        image.double().cpu() for image in (rendering.rgb, rendering.alpha, rendering.depth)
    )
    pictures = (rgb * torch.cos(2 * x + y)).mean() + (rgb * torch.sin(x - 2 * y)).mean()
    return pictures + (alpha * torch.cos(x + 2 * y)).mean() + (depth * torch.sin(2 * x - y)).mean()
