"""Checks of renderers: background, depth, directions, features and gradients.

Gradients are compared with finite differences in a scene where images change smoothly: every
Gaussian contributes to every pixel, with an alpha far above `alpha_min`, no Gaussian hides another
one completely, and small steps do not change the order of depths.
"""

from typing import Any

import torch
from torch import Tensor

from qgs.containers import map_tensors, named_tensors
from qgs.geometry.harmonics import seen_colors
from qgs.geometry.transforms import to_camera
from qgs.types import SH_COUNTS
from qgs_dev.case import Case
from qgs_dev.inputs import Maker, Sizes
from qgs_dev.vocabulary import (
    Trial,
    expect,
    expect_finite,
    expect_inside,
    expect_none,
    expect_right_gradient,
    expect_same,
    gradients,
    leaves,
    mapped,
    scalar,
    tracked,
)

CAMERA_TENSORS = ("c2w", "intrinsics")


def check_no_gaussians_give_the_background(case: Case) -> None:
    """Require that a scene without Gaussians renders as the background, with finite gradients."""
    trial = Trial(case)
    inputs = trial.tracked()
    # Scenes without Gaussians occur: an opacity limit may remove all.
    inputs["gaussians"] = tracked(map_tensors(lambda x: x[:, :0], inputs["gaussians"]))
    colour = torch.tensor([0.1, 0.6, 0.9]).to(case.device)
    out = trial(inputs, background=colour)
    background = colour[:, None, None].expand_as(out.rgb)
    expect_same(out.rgb, background, "the image is not the background", atol=1e-6)
    expect(not (out.alpha.any() or out.depth.any()), "alpha or depth is not zero")
    expect_finite(out, "in the rendering")
    expect_finite(gradients(scalar(out), inputs), "in the gradient")


def check_rendering_is_over_the_background(case: Case) -> None:
    """Require that alpha is in [0, 1] and that the background has the weight 1 - alpha."""
    trial = Trial(case)
    # The images before white and before black differ by 1 - alpha.
    dark, light = (trial(background=torch.full((3,), v).to(case.device)) for v in (0.0, 1.0))
    expect_inside(dark.alpha, 0, 1 + 1e-5, "values of alpha")
    missing = (1 - dark.alpha).expand_as(dark.rgb)
    where = "the weight of the background is not 1 - alpha"
    expect_same(missing, light.rgb - dark.rgb, where, atol=1e-4)


def check_depth_is_expected(case: Case) -> None:
    """Require that depth is the mean camera-frame z of Gaussians, weighted as in blending."""
    trial = _broad(case, views=2)
    cameras = trial.inputs["cameras"]
    pair, near, far = (trial.inputs["gaussians"][:, at] for at in ([0, -1], [0], [-1]))
    seen = trial(gaussians=pair).depth
    front = trial(gaussians=near).alpha
    # Two Gaussians are enough to distinguish blending from a sum or a mean.
    behind = (1 - front) * trial(gaussians=far).alpha
    z = to_camera(pair.means, cameras)[..., 2:, None]
    hit = front + behind
    expected = (front * z[:, :, :1] + behind * z[:, :, 1:]) / hit.clamp_min(1e-6)
    visible = hit > 0.05
    expect_same(expected[visible], seen[visible], "depth is not the expected z", atol=1e-3)


def check_colours_depend_on_the_direction(case: Case) -> None:
    """Require that Gaussians with `sh` look like Gaussians with fixed colours in each view.

    The fixed colours are those that `sh` gives in the direction from the camera of the view.
    Coefficients of zero must not change the image.
    """
    trial = Trial(case, Sizes(views=3))
    cameras = trial.inputs["cameras"]
    gaussians = trial.inputs["gaussians"]
    maker = Maker(case)
    for count in SH_COUNTS:
        varying = gaussians.replace(sh=0.3 * maker.normal("BG", count, 3))
        rgb = trial(gaussians=varying).rgb
        colors = seen_colors(varying, cameras)
        for view in range(cameras.shape[1]):
            # The colours of this one view, without dependence on the direction.
            fixed = gaussians.replace(sh=None, colors=colors[:, view])
            expected = trial(gaussians=fixed, cameras=cameras[:, [view]]).rgb
            where = f"with {count} coefficients, view {view} has other colours than `sh` gives"
            expect_same(expected, rgb[:, [view]], where, atol=1e-4)
    without, zeros = (
        trial(gaussians=gaussians.replace(sh=sh)).rgb for sh in (None, 0 * gaussians.sh)
    )
    expect_same(without, zeros, "coefficients of zero change the image", atol=1e-4)


def check_features_are_blended_as_colours(case: Case) -> None:
    """Require that features are blended like colours on black, for any number of channels.

    Features must not change the image. If Gaussians have no features, the rendering must have none.
    """
    trial = Trial(case)
    black = torch.zeros(3).to(case.device)
    gaussians = trial.inputs["gaussians"].replace(sh=None)
    bare = gaussians.replace(features=None)
    plain = trial(gaussians=bare)
    out = trial(gaussians=gaussians)
    expect(plain.features is None, "the rendering has features, but the Gaussians have none")
    expect(out.features is not None, "the rendering has no features, but the Gaussians have some")
    expect_same(plain.rgb, out.rgb, "features change the colours", atol=1e-4)
    for first in (0, gaussians.features.shape[-1] - 3):
        shown = slice(first, first + 3)
        painted = bare.replace(colors=gaussians.features[..., shown])
        expected = trial(gaussians=painted, background=black).rgb
        expect_same(
            expected, out.features[:, :, shown], "features are not blended as colours", atol=1e-4
        )


def check_render_gradients_match_differences(case: Case) -> None:
    """Require that gradients with respect to Gaussians agree with finite differences."""
    trial = _broad(case)
    given = {"gaussians": tracked(trial.inputs["gaussians"])}
    for name, gradient in gradients(_brightness(trial(**given)), given).items():
        _expect_changes(trial, name, gradient)


def check_camera_gradients_match_differences(case: Case) -> None:
    """Require that camera gradients agree with finite differences, or are refused.

    The gradients are those with respect to poses and intrinsics. A renderer may raise ValueError
    for a camera tensor that requires a gradient and is not listed in `camera_gradients`.
    """
    component: Any = case.component
    declared = component.camera_gradients
    unknown = {*declared} - {*CAMERA_TENSORS}
    expect_none(unknown, "listed in `camera_gradients`, but not a tensor of the cameras")
    trial = _broad(case, seed=1)
    for name in CAMERA_TENSORS:
        full = f"cameras.{name}"
        given = mapped(trial.inputs, lambda n, x, full=full: x.clone().requires_grad_(n == full))
        try:
            found = gradients(_brightness(trial(given)), given)
        except ValueError as error:
            seen = f"`camera_gradients` lists {name}, but its gradient is refused: {error}"
            expect(name not in declared, seen)
            continue
        expect(full in found, f"`{name}` requires a gradient and gets none; raise ValueError")
        _expect_changes(trial, full, found[full])


def _broad(case: Case, seed: int = 0, views: int = 1) -> Trial:
    """Return a trial with `views` cameras that see broad Gaussians one behind another."""
    sizes = Sizes(batch=1, queries=3, views=views)
    trial = Trial(case, sizes, seed)
    maker = Maker(case, sizes, seed)
    means = maker.uniform(-0.25, 0.25, "BG3")
    # Depths are far enough apart that no step changes their order.
    means[..., 2] = 1.6 + 0.13 * torch.arange(means.shape[1]).to(means)
    trial.inputs["gaussians"] = trial.inputs["gaussians"].replace(
        means=means,
        scales=maker.uniform(0.85, 1.7, "BG3"),
        opacities=maker.uniform(0.3, 0.5, "BG"),
        # These colours stay above 0 with `sh` too.
        colors=maker.uniform(0.5, 1, "BG3"),
    )
    return trial


def _expect_changes(trial: Trial, name: str, gradient: Tensor) -> None:
    """Expect that small changes of the input `name` change the image as its gradient predicts.

    Tensors of Gaussians change along the gradient and channel by channel. Cameras move along and
    turn about each of their axes. Focal lengths and principal points change one by one.
    """
    x = leaves(trial.inputs)[name]
    # Pixels.
    size = 0.01 if name.startswith("gaussians") else 0.5
    moves = [*size * torch.eye(x[0, 0].numel()).to(x).reshape(-1, *x[0, 0].shape)]
    if name.startswith("gaussians"):
        along = 0.03 * gradient / gradient.norm().clamp_min(1e-12)
        moves = [along, *(move.expand_as(x) for move in moves)]
    if name == "cameras.c2w":
        axes = torch.eye(3).to(x)
        motions = torch.zeros(6, 4, 4).to(x)
        motions[:3, :3, 3] = axes
        # The cross product with an axis is the start of a turn about it.
        motions[3:, :3, :3] = torch.linalg.cross(axes[None], axes[:, None])
        # World units, and radians.
        moves = [*0.02 * motions]

    def value(steps: Tensor) -> Tensor:
        move = torch.einsum("s,s...->...", steps.to(x), torch.stack(moves))
        moved = x @ torch.matrix_exp(move) if name == "cameras.c2w" else x + move
        inputs = mapped(trial.inputs, lambda n, x: moved if n == name else x)
        return _brightness(trial(inputs))

    steps = torch.zeros(len(moves), dtype=torch.float64, requires_grad=True)
    # A GPU adds numbers in no fixed order.
    tolerances = {"eps": 1.0, "atol": 1e-6, "rtol": 0.03, "nondet_tol": 1e-3}
    expect_right_gradient(value, steps, f"steps of `{name}`", **tolerances)


def _brightness(rendering: Any) -> Tensor:
    """Return a weighted mean of a rendering's colours, alpha, depth and features.

    Weights vary smoothly over the image, and differ between images.
    """
    total = torch.zeros(()).double()
    for number, (_, image) in enumerate(named_tensors(rendering), 1):
        y, x = (torch.linspace(-1, 1, size, dtype=torch.float64) for size in image.shape[-2:])
        y = y[:, None]
        # Weights are smooth and differ for each image and axis, so that nothing cancels.
        waves = torch.cos(number * x + y) + torch.sin(x - number * y)
        total = total + (image.double().cpu() * waves).mean()
    return total
